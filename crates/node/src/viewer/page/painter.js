// Draws particles with WebGL 2, directly from the received bytes.

import { aspectOf } from "/frame.js";
import { colourStart } from "/scale.js";

const VERTEX = `#version 300 es
layout(location = 0) in vec2 position;  // 0 to 1 across the domain
layout(location = 1) in float speed;    // square root of the share of the top speed
layout(location = 2) in float error;    // 0 to 1, logarithmic
layout(location = 3) in uint material;
uniform vec2 centre;                    // of the view, 0 to 1 across the domain
uniform vec2 extent;                    // of the domain, 1 if it is as large as the plot
uniform float size;
uniform int colouring;                  // 0 material, 1 speed, 2 error, 3 plain
uniform vec3 materials[5];
uniform vec3 scale[9];
uniform float from;                     // start of the scale
uniform vec2 limits;                    // offset and factor from a level to a position on the scale
uniform vec3 plain;
out vec3 colour;
vec3 shade(float share) {
  float at = mix(from, 1.0, clamp(share, 0.0, 1.0)) * 8.0;
  int below = min(int(at), 7);
  return mix(scale[below], scale[below + 1], at - float(below));
}
void main() {
  gl_Position = vec4(2.0 * (position - centre) * extent, 0.0, 1.0);
  gl_PointSize = size;
  float level = colouring == 1 ? speed * speed : error;
  colour = colouring == 0 ? materials[min(material, 4u)]
    : colouring == 3 ? plain : shade((level - limits.x) * limits.y);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec3 colour;
uniform float size;
uniform float strength;
out vec4 pixel;
void main() {
  float edge = 0.5 * size * (1.0 - length(2.0 * gl_PointCoord - 1.0));
  float cover = size < 3.0 ? 1.0 : clamp(edge + 0.5, 0.0, 1.0);
  pixel = vec4(colour, 1.0) * (strength * cover);
}`;

const COLOURINGS = ["material", "speed", "error", "plain"];
// Of tools and of forces on them, as in `palette`.
const TOOL = [95, 100, 110];
const FORCE = [190, 30, 45];
// Share of the domain that particles at rest cover, approximately.
const COVERAGE = 0.22;
// Largest particle (pixels), without and with zoom.
const LARGEST = 10;
const LARGEST_ZOOMED = 48;

export class Painter {
  /** `redraw` is called when the drawing was lost. */
  constructor(canvas, redraw) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl2", { antialias: false, alpha: true, premultipliedAlpha: true });
    if (!this.gl) throw new Error("this browser does not support WebGL 2");
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.prepare();
      redraw();
    });
    this.prepare();
  }

  prepare() {
    const gl = this.gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
        throw new Error(gl.getShaderInfoLog(shader));
      }
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(gl.getProgramInfoLog(program));
    }
    gl.useProgram(program);
    this.uniform = Object.fromEntries(
      ["centre", "extent", "size", "colouring", "materials", "scale", "from", "limits", "plain", "strength"]
        .map((name) => [name, gl.getUniformLocation(program, name)]));
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    for (let place = 0; place < 4; place++) gl.enableVertexAttribArray(place);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.loaded = null;
    const known = gl.getExtension("WEBGL_debug_renderer_info");
    this.renderer = gl.getParameter(known ? known.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  }

  /** Materials and scale as lists of [red, green, blue], 0 to 255. */
  colours(materials, scale) {
    const flat = (colours) => new Float32Array(colours.flat().map((part) => part / 255));
    this.palette = [flat(materials), flat(scale)];
  }

  /**
   * Draws `frame` into panels: each has an element, and layers with side, colouring, strength and growth. `limits` are
   * those of the colour scale.
   */
  draw(frame, panels, { background, outside, plain, dark }, camera, limits) {
    const { gl, canvas, uniform } = this;
    if (gl.isContextLost() || !this.palette) return;
    const box = canvas.getBoundingClientRect();
    const density = devicePixelRatio || 1;
    const [width, height] = [box.width, box.height].map((length) => Math.max(1, Math.round(length * density)));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.disable(gl.SCISSOR_TEST);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.SCISSOR_TEST);
    if (frame && this.loaded !== frame) {
      gl.bufferData(gl.ARRAY_BUFFER, frame.buffer, gl.STREAM_DRAW);
      this.loaded = frame;
    }
    gl.uniform3fv(uniform.materials, this.palette[0]);
    gl.uniform3fv(uniform.scale, this.palette[1]);
    gl.uniform1f(uniform.from, colourStart(dark));
    gl.uniform2fv(uniform.limits, limits);
    gl.uniform3fv(uniform.plain, plain);
    gl.uniform2fv(uniform.centre, camera.centre);
    for (const { element, layers } of panels) {
      const rect = element.getBoundingClientRect();
      if (!rect.width) continue;
      const pixels = (left, top, wide, high) =>
        [left, box.height - top - high, wide, high].map((length) => Math.round(length * density));
      const [left, top, wide, high] = [rect.left - box.left, rect.top - box.top, rect.width, rect.height];
      const plot = pixels(left, top, wide, high);
      gl.viewport(...plot);
      const fill = (place, colour) => {
        gl.scissor(...place);
        gl.clearColor(...colour, 1);
        gl.clear(gl.COLOR_BUFFER_BIT);
      };
      if (!frame) {
        fill(plot, background);
        continue;
      }
      fill(plot, outside);
      camera.aspect = aspectOf(frame);
      const fitted = camera.fitted(wide, high).map((length) => length * camera.zoom);
      const edge = (length, size, centre) => {
        const low = length / 2 - centre * size;
        return [Math.max(low, 0), Math.min(low + size, length)];
      };
      const [west, east] = edge(wide, fitted[0], camera.centre[0]);
      const [south, north] = edge(high, fitted[1], camera.centre[1]);
      fill(pixels(left + west, top + high - north, east - west, north - south), background);
      gl.uniform2f(uniform.extent, fitted[0] / wide, fitted[1] / high);
      const area = (fitted[0] * fitted[1] * density * density) / camera.zoom ** 2;
      const spacing = Math.sqrt((COVERAGE * area) / frame.particles);
      for (const { side, colouring, strength = 1, growth = 1 } of layers) {
        if (!frame[side].present) continue;
        const size = Math.min(Math.max(1.15 * growth * spacing, 1.3 * density), LARGEST * density);
        gl.uniform1f(uniform.size, Math.min(size * camera.zoom, LARGEST_ZOOMED * density));
        gl.uniform1f(uniform.strength, strength);
        gl.uniform1i(uniform.colouring, COLOURINGS.indexOf(colouring));
        gl.vertexAttribPointer(0, 2, gl.UNSIGNED_SHORT, true, 4, frame[side].position);
        gl.vertexAttribPointer(1, 1, gl.UNSIGNED_BYTE, true, 1, frame[side].speed);
        gl.vertexAttribPointer(2, 1, gl.UNSIGNED_BYTE, true, 1, frame.errors);
        gl.vertexAttribIPointer(3, 1, gl.UNSIGNED_BYTE, 1, frame.materials);
        gl.drawArrays(gl.POINTS, 0, frame.particles);
      }
      this.drawShapes(frame.shapes);
      gl.uniform3fv(uniform.plain, plain);
    }
  }

  /** Draws tools and the forces on them as triangles. */
  drawShapes({ at, tools, forces }) {
    const { gl, uniform } = this;
    if (!tools) return;
    for (const place of [1, 2, 3]) gl.disableVertexAttribArray(place);
    gl.vertexAttribI4ui(3, 0, 0, 0, 0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 8, at);
    gl.uniform1f(uniform.size, 1);
    gl.uniform1f(uniform.strength, 1);
    gl.uniform1i(uniform.colouring, COLOURINGS.indexOf("plain"));
    for (const [colour, first, count] of [[TOOL, 0, tools], [FORCE, tools, forces]]) {
      gl.uniform3fv(uniform.plain, colour.map((part) => part / 255));
      gl.drawArrays(gl.TRIANGLES, first, count);
    }
    for (const place of [1, 2, 3]) gl.enableVertexAttribArray(place);
  }
}
