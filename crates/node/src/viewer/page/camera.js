// Zoom and pan of the panels, which show the same part of the domain.

const MAX_ZOOM = 40;
const WHEEL = 0.0015; // exponent of the zoom per pixel of the wheel

export class Camera {
  /** Listens to the pointers on `plots`; `changed` is called when the view changes. */
  constructor(plots, changed) {
    this.changed = changed;
    this.aspect = 1; // of the domain
    this.zoom = 1;
    this.centre = [0.5, 0.5]; // of the view, 0 to 1 across the domain
    for (const plot of plots) this.listen(plot);
  }

  /** Width and height of the whole domain in a box of this size. */
  fitted(width, height) {
    const wide = Math.min(width, height * this.aspect);
    return [wide, wide / this.aspect];
  }

  /** A place of the window in pixels right of and above the middle of a plot. */
  offset(plot, x, y) {
    const box = plot.getBoundingClientRect();
    return [x - box.left - box.width / 2, box.top + box.height / 2 - y];
  }

  /** The point of the domain at a place of the window, 0 to 1 across the domain. */
  at(plot, x, y) {
    const offset = this.offset(plot, x, y);
    const size = this.fitted(plot.clientWidth, plot.clientHeight);
    return this.centre.map((part, axis) => part + offset[axis] / size[axis] / this.zoom);
  }

  reset() {
    this.view(1, [0.5, 0.5]);
  }

  /** Magnifies by `factor`; the point at `offset` (pixels right of and above the middle of the plot) stays. */
  magnify(factor, plot, offset = [0, 0]) {
    const zoom = Math.min(Math.max(this.zoom * factor, 1), MAX_ZOOM);
    const size = this.fitted(plot.clientWidth, plot.clientHeight);
    const moved = (axis) => (offset[axis] / size[axis]) * (1 / this.zoom - 1 / zoom);
    this.view(zoom, this.centre.map((part, axis) => part + moved(axis)));
  }

  /** Moves the view by this many pixels to the right and upwards. */
  pan(offset, plot) {
    const size = this.fitted(plot.clientWidth, plot.clientHeight);
    this.view(this.zoom, this.centre.map((part, axis) => part + offset[axis] / size[axis] / this.zoom));
  }

  view(zoom, centre) {
    const half = 0.5 / zoom;
    this.zoom = zoom;
    this.centre = centre.map((part) => Math.min(Math.max(part, half), 1 - half));
    this.changed();
  }

  listen(plot) {
    const pointers = new Map();
    const offset = (x, y) => this.offset(plot, x, y);
    /** Middle of the pointers and their distance. */
    const grip = () => {
      const all = [...pointers.values()];
      const middle = [0, 1].map((axis) => all.reduce((sum, one) => sum + one[axis], 0) / all.length);
      return { middle, apart: all.length > 1 ? Math.hypot(all[0][0] - all[1][0], all[0][1] - all[1][1]) : 0 };
    };
    plot.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      pointers.set(event.pointerId, offset(event.clientX, event.clientY));
      plot.setPointerCapture(event.pointerId);
    });
    plot.addEventListener("pointermove", (event) => {
      if (!pointers.has(event.pointerId)) return;
      const before = grip();
      pointers.set(event.pointerId, offset(event.clientX, event.clientY));
      const after = grip();
      if (before.apart && after.apart) this.magnify(after.apart / before.apart, plot, after.middle);
      if (this.zoom > 1) this.pan([0, 1].map((axis) => before.middle[axis] - after.middle[axis]), plot);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      plot.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
    plot.addEventListener("wheel", (event) => {
      // The wheel scrolls the page where there is nothing to zoom out of.
      if (event.deltaY >= 0 && this.zoom === 1) return;
      event.preventDefault();
      const pixels = event.deltaY * (event.deltaMode === WheelEvent.DOM_DELTA_LINE ? 30 : 1);
      this.magnify(Math.exp(-WHEEL * pixels), plot, offset(event.clientX, event.clientY));
    }, { passive: false });
    plot.addEventListener("dblclick", () => this.reset());
  }
}
