"""The animation for notebooks: what is in its HTML."""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import eddy
import numpy as np
import pytest


def shown(player: eddy.Player) -> dict[str, Any]:
    """The data in the page of a player."""
    outer = player._repr_html_()
    page = html.unescape(outer[outer.index('srcdoc="') + 8 : outer.index('" width=')])
    found = re.search(r"^const data = (.*);$", page, re.MULTILINE)
    assert found is not None
    data: dict[str, Any] = json.loads(found.group(1))
    return data


def positions(panel: dict[str, Any], number: int, lower: float = 0.0, upper: float = 1.0) -> np.ndarray:
    """Positions of an instant as the script computes them."""
    whole = np.frombuffer(base64.b64decode(panel["positions"][number]), "<u2").reshape(-1, 2)
    return lower + (upper - lower) * (whole / 65535 * 1.1 - 0.05)


def test_frames_are_shown_at_their_places() -> None:
    frames = list(eddy.Solver(eddy.Scene.generate("kinds", seed=2, id=3, particles=300), duration=0.2))
    player = eddy.Player(frames)
    data = shown(player)
    (panel,) = data["panels"]
    assert len(player) == len(frames) == len(data["times"])
    assert data["times"][2] == frames[2].time
    for number in (0, 5, len(frames) - 1):
        assert np.abs(positions(panel, number) - frames[number].position).max() < 1e-4
    assert np.array_equal(np.frombuffer(base64.b64decode(panel["materials"][0]), np.uint8), frames[0].material)
    assert set(panel["materials"][1:]) == {""}, "the same particles are not repeated"


def test_frames_of_one_time_are_side_by_side(block: eddy.Frame) -> None:
    later = eddy.Frame(block.position, block.velocity, "snow", time=0.016)
    data = shown(eddy.Player({"truth": [block, later], "predicted": [later]}, width=200))
    truth, predicted = data["panels"]
    assert (truth["title"], predicted["title"], data["times"]) == ("truth", "predicted", [0.0, 0.016])
    assert predicted["positions"][0] == "" and predicted["positions"][1] == truth["positions"][1]
    assert truth["materials"][1] != "", "other particles than before"


def test_a_bag_and_arrays_give_the_same(bags: Path) -> None:
    bag = eddy.Bag(bags / "scene_0004")
    arrays = bag.arrays()
    of_arrays = shown(eddy.Player(arrays["position"], material=arrays["material"]))
    assert shown(eddy.Player(bag)) == of_arrays
    fewer = eddy.Player(bag, every=3)
    assert len(fewer) == len(range(0, len(bag), 3))
    assert shown(fewer)["panels"][0]["positions"][1] == of_arrays["panels"][0]["positions"][3]


def test_particles_outside_of_the_domain_are_not_visible() -> None:
    position = np.array([[[0.5, 0.5], [3.0, 0.5], [np.nan, 0.5]]], np.float32)
    (panel,) = shown(eddy.Player(position))["panels"]
    found = positions(panel, 0)
    assert np.abs(found[0] - 0.5).max() < 1e-4
    assert (found[1:] < 0).all(), "beyond the edge of the picture"


def test_a_page_of_its_own(tmp_path: Path, block: eddy.Frame) -> None:
    player = eddy.Player({"</script><b>": [block]})
    player.save(tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("</script>") == 1, "a title cannot end the script"
    assert not re.search(r"https?:|<link|<img|src=", page), "it needs nothing else"
    assert html.unescape(player._repr_html_()).count("<!DOCTYPE html>") == 1
    assert repr(player) == "Player(panels=1, frames=1)"


@pytest.mark.parametrize(
    ("source", "options", "message"),
    [
        ([], {}, "source: found no frames, expected at least 1"),
        ({}, {}, "source: found no panels, expected at least 1"),
        ({"a": []}, {}, r"source\['a'\]: found no frames"),
        ([1, 2], {}, "source: found int, expected frames"),
        (np.zeros((3, 2), np.float32), {}, r"source: found shape \[3, 2\], expected shape \[T, N, 2\]"),
        (np.zeros((1, 3, 2), np.float32), {"material": np.zeros(2, np.uint8)}, r"material: found shape \[2\]"),
        (np.zeros((1, 3, 2), np.float32), {"every": 0}, "every: found 0, expected at least 1"),
        (np.zeros((1, 3, 2), np.float32), {"width": 5}, "width: found 5, expected 50 to 4000"),
        (np.zeros((1, 3, 2), np.float32), {"upper": (0.0, 1.0)}, "lower, upper: found"),
    ],
)
def test_wrong_arguments_are_named(source: Any, options: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        eddy.Player(source, **options)
