"""Animations of particles for notebooks."""

import base64
import html
import json
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._eddy import Bag, Frame

#: Colours of liquid, snow, jelly, rope and sand, from the palette of Okabe and Ito ("Color Universal Design", 2008).
_COLOURS = ("#0072b2", "#56b4e9", "#e69f00", "#d55e00", "#cc79a7")
#: Positions are stored as whole numbers from 0 to this, across a domain that is a twentieth larger on every side.
_STEPS = 2**16 - 1
_MARGIN = 0.05

_Source = Bag | Iterable[Frame] | NDArray[np.float32]


class _Panel(NamedTuple):
    """What a panel shows: particles at instants."""

    title: str
    #: Simulation time of each frame (ns).
    stamps: list[int]
    #: Positions, float32 [N, 2] of each frame.
    positions: list[NDArray[np.float32]]
    materials: list[NDArray[np.uint8]]
    lower: tuple[float, ...]
    upper: tuple[float, ...]


class Player:
    """An animation of particles, which a notebook shows when it is the last value of a cell.

    It is one piece of HTML that needs neither a network nor any other package. A saved notebook keeps it, at four bytes
    for each particle and frame.
    """

    def __init__(
        self,
        source: _Source | Mapping[str, _Source],
        *,
        material: NDArray[np.uint8] | None = None,
        dt: float = 0.016,
        lower: Sequence[float] = (0.0, 0.0),
        upper: Sequence[float] = (1.0, 1.0),
        every: int = 1,
        width: int = 320,
    ) -> None:
        """``source``: frames, the topic ``/particles`` of a bag, or positions as float32 [T, N, 2]; a dictionary of these
        by their titles is shown side by side. Frames of the same simulation time are shown together. ``material`` (uint8
        [N]), ``dt`` (s), ``lower`` and ``upper`` (corners of the domain) belong to positions: frames have their own.
        ``every``: only every so many instants are kept. ``width``: of a panel (pixels).
        """
        if every < 1:
            raise ValueError(f"every: found {every}, expected at least 1")
        if not 50 <= width <= 4000:
            raise ValueError(f"width: found {width}, expected 50 to 4000 pixels")
        sources = source if isinstance(source, Mapping) else {"": source}
        if not sources:
            raise ValueError("source: found no panels, expected at least 1")
        corners = (float(lower[0]), float(lower[1])), (float(upper[0]), float(upper[1]))
        if not (corners[0][0] < corners[1][0] and corners[0][1] < corners[1][1]):
            raise ValueError(f"lower, upper: found {corners[0]}, {corners[1]}, expected an area")
        panels = [_panel(title, one, material, dt, *corners) for title, one in sources.items()]
        stamps = sorted({stamp for panel in panels for stamp in panel.stamps})[::every]
        self._width = width
        self._height = max(round(width * _height(panel) / _width(panel)) for panel in panels)
        self._panels = len(panels)
        self._frames = len(stamps)
        shown = {
            "times": [stamp / 1e9 for stamp in stamps],
            "width": width,
            "colours": _COLOURS,
            "panels": [_encoded(panel, stamps) for panel in panels],
        }
        # A title may hold `</script>`.
        page = Path(__file__).with_name("_player.html").read_text(encoding="utf-8")
        self._page = page.replace("DATA", json.dumps(shown, separators=(",", ":")).replace("</", "<\\/"))

    def save(self, path: str | PathLike[str]) -> None:
        """Writes the animation as an HTML page of its own."""
        Path(path).write_text(self._page, encoding="utf-8")

    def _repr_html_(self) -> str:
        width, height = self._panels * (self._width + 12) + 8, self._height + 76
        return (
            f'<iframe srcdoc="{html.escape(self._page)}" width="{width}" height="{height}"'
            ' style="border:0;max-width:100%" sandbox="allow-scripts" title="particles"></iframe>'
        )

    def __len__(self) -> int:
        """Number of instants."""
        return self._frames

    def __repr__(self) -> str:
        return f"Player(panels={self._panels}, frames={self._frames})"


def _width(panel: _Panel) -> float:
    return panel.upper[0] - panel.lower[0]


def _height(panel: _Panel) -> float:
    return panel.upper[1] - panel.lower[1]


def _panel(
    title: str,
    source: _Source,
    material: NDArray[np.uint8] | None,
    dt: float,
    lower: tuple[float, float],
    upper: tuple[float, float],
) -> _Panel:
    name = f"source[{title!r}]" if title else "source"
    if isinstance(source, np.ndarray):
        if source.ndim != 3 or source.shape[0] == 0 or source.shape[2] != 2:
            raise ValueError(f"{name}: found shape {list(source.shape)}, expected shape [T, N, 2]")
        particles = source.shape[1]
        kinds = np.zeros(particles, np.uint8) if material is None else np.asarray(material)
        if kinds.shape != (particles,):
            raise ValueError(f"material: found shape {list(kinds.shape)}, expected shape [{particles}]")
        stamps = [round(1e9 * dt * number) for number in range(len(source))]
        return _Panel(title, stamps, list(source), [kinds] * len(source), lower, upper)
    frames = list(source.frames() if isinstance(source, Bag) else source)
    for frame in frames:
        if not isinstance(frame, Frame):
            found = type(frame).__name__
            raise TypeError(f"{name}: found {found}, expected frames, a bag or a NumPy array [T, N, 2]")
        if len(frame.lower) != 2:
            raise ValueError(f"{name}: found frames of {len(frame.lower)} dimensions, expected 2")
    if not frames:
        raise ValueError(f"{name}: found no frames, expected at least 1")
    return _Panel(
        title,
        [frame.stamp for frame in frames],
        [frame.position for frame in frames],
        [frame.material for frame in frames],
        frames[0].lower,
        frames[0].upper,
    )


def _encoded(panel: _Panel, stamps: list[int]) -> dict[str, Any]:
    """A panel for the script: one entry for each instant, empty where the panel has no frame."""
    lower, upper = np.array(panel.lower), np.array(panel.upper)
    margin = _MARGIN * (upper - lower)
    scale = _STEPS / (upper - lower + 2 * margin)
    frame_of = {stamp: number for number, stamp in enumerate(panel.stamps)}
    positions: list[str] = []
    materials: list[str] = []
    last: NDArray[np.uint8] | None = None
    for stamp in stamps:
        number = frame_of.get(stamp)
        if number is None:
            positions.append("")
            materials.append("")
            continue
        position = np.nan_to_num((panel.positions[number] - lower + margin) * scale, nan=-1.0)
        inside = ((position >= 0) & (position <= _STEPS)).all(axis=-1)
        # Particles outside are drawn in the corner that is never visible.
        whole = np.where(inside[:, None], np.rint(position), 0).astype("<u2")
        positions.append(base64.b64encode(whole.tobytes()).decode())
        # The same particles as before are not repeated.
        material = panel.materials[number].astype(np.uint8)
        same = last is not None and np.array_equal(last, material)
        materials.append("" if same else base64.b64encode(material.tobytes()).decode())
        last = material
    return {
        "title": panel.title,
        "height": _height(panel) / _width(panel),
        "positions": positions,
        "materials": materials,
    }
