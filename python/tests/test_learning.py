"""Training and evaluation."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import eddy
import numpy as np
import pytest

SMALL = {
    "architecture": "particle",
    "epochs": 2,
    "network": {"encoder": 8, "hidden": 8, "channels": [4, 4, 4]},
    "windows": {"per_epoch": 8, "batch": 4},
    "unroll": [{"share": 1.0, "frames": 2}],
    "validation": {"horizon": 5, "starts": 1},
}


def test_a_network_is_trained_evaluated_and_used(tmp_path: Path, bags: Path) -> None:
    epochs: list[int] = []
    outcome = eddy.train(bags, tmp_path / "model", SMALL, callback=lambda epoch: epochs.append(epoch["epoch"]))
    assert epochs == [1, 2] == [epoch["epoch"] for epoch in outcome["epochs"]]
    surrogate = eddy.Surrogate(tmp_path / "model")
    assert surrogate.digest == outcome["digest"]

    report = eddy.evaluate(bags, tmp_path / "model", horizon=5, starts=2)
    results = report.to_dict()
    assert results["horizon"] == 5
    assert "Skill" in report.tables()
    report.save(tmp_path / "report")
    assert (tmp_path / "report" / "report.html").exists()

    with pytest.raises(eddy.TrainError, match="exists|resume"):
        eddy.train(bags, tmp_path / "model", SMALL)

    still = {**SMALL, "optimizer": {"learning_rate": 1e-9}}
    tuned = eddy.train(bags, tmp_path / "tuned", still, start=tmp_path / "model")
    assert tuned["epochs"][0]["weight_distance"] < 1e-6
    assert f'start = "{outcome["digest"]}"' in (tmp_path / "tuned" / "model.toml").read_text()
    with pytest.raises(eddy.TrainError, match="core: found .gru., expected .mingru. as in the checkpoint"):
        eddy.train(bags, tmp_path / "other", {"core": "gru"}, start=tmp_path / "model")


def test_a_network_is_conditioned_on_the_stiffness_of_each_scene_and_of_each_stream(tmp_path: Path) -> None:
    program, bags = Path(sys.executable).with_name("eddy"), tmp_path / "bags"
    scenes = ["--preset", "kinds", "--particles", "250", "--scenes", "10", "--duration", "0.8"]
    subprocess.run([program, "simulate", *scenes, "--stiffness", "300..3e4", "--output", bags], check=True)
    conditioned = {**SMALL, "network": {**SMALL["network"], "stiffness": True}}
    eddy.train(bags, tmp_path / "model", conditioned)
    surrogate = eddy.Surrogate(tmp_path / "model")
    first = next(iter(eddy.Bag(bags / "scene_0001").frames()))
    soft, stiff = (surrogate.stream(first, stiffness=stiffness).step(first) for stiffness in (1e3, 1e5))
    assert soft != stiff
    with pytest.raises(ValueError, match="stiffness: found nothing, expected Young's modulus"):
        surrogate.stream(first)
    # The shipped model assumes a stiffness.
    shipped = eddy.Surrogate()
    assert shipped.stream(first).step(first) == shipped.stream(first, stiffness=1e3).step(first)
    eddy.train(bags, tmp_path / "plain", SMALL)
    with pytest.raises(ValueError, match="stiffness: found 1000, expected nothing"):
        eddy.Surrogate(tmp_path / "plain").stream(first, stiffness=1e3)
    with pytest.raises(ValueError, match="stiffness: found nothing, expected Young's modulus"):
        eddy.Node("shm:/stiffness/in", "shm:/stiffness/out", surrogate).start()

    own = eddy.evaluate(bags, tmp_path / "model", horizon=5, starts=2).to_dict()
    given = eddy.evaluate(bags, tmp_path / "model", horizon=5, starts=2, stiffness=3e5).to_dict()
    assert own["predictors"][0]["skill"] != given["predictors"][0]["skill"]
    (bags / "manifest.json").unlink()
    stated = eddy.evaluate(bags, tmp_path / "model", horizon=5, starts=2).to_dict()
    assert stated["predictors"][0]["skill"] == own["predictors"][0]["skill"]
    for metadata in bags.glob("*/metadata.yaml"):
        metadata.write_text(metadata.read_text().replace("eddy_stiffness: ", "run: "))
    with pytest.raises(eddy.TrainError, match="scene_.*stiffness: found nothing, expected eddy_stiffness"):
        eddy.train(bags, tmp_path / "other", conditioned)


def test_skill_of_any_rollouts_is_that_of_eddy_eval(bags: Path) -> None:
    """Of the trivial predictors: the best of them has skill 0, the truth 1."""
    arrays = eddy.Bag(bags / "scene_0002").arrays()
    frames = list(eddy.Bag(bags / "scene_0002").frames())
    starts, horizon = [2, 9], 6
    truth = np.stack([arrays["position"][s + 1 : s + 1 + horizon] for s in starts])
    first = [frames[s] for s in starts]
    assert np.array_equal(eddy.skill(first, truth, truth), np.ones(horizon))
    still = np.stack([np.repeat(arrays["position"][s][None], horizon, axis=0) for s in starts])
    assert (eddy.skill(first, truth, still) <= 0.0).all()
    half = ((truth.astype(np.float64) + still) / 2).astype(np.float32)
    assert (eddy.skill(first, truth, half) > eddy.skill(first, truth, still)).all()
    with pytest.raises(ValueError, match="predicted: found shape"):
        eddy.skill(first, truth, still[:, :3].copy())
    with pytest.raises(ValueError, match="starts: found no frames"):
        eddy.skill([], truth, still)
    with pytest.raises(ValueError, match="truth: found 0 frames, expected at least 1"):
        eddy.skill(first, truth[:, :0], still[:, :0])


def test_rollouts_of_another_predictor_are_judged_beside_a_model(tmp_path: Path, bags: Path) -> None:
    """Those of persistence have the skill of the baseline of that name, the truth itself has 1."""
    horizon, starts = 5, eddy.evaluation_starts(bags, horizon=5, starts=2)
    assert all(len(entry["sequences"]) == 2 for entry in starts)
    for name in ("still", "true"):
        with eddy.BagWriter(tmp_path / name) as writer:
            for entry in starts:
                frames = {frame.sequence: frame for frame in eddy.Bag(entry["bag"]).frames()}
                for source in entry["sequences"]:
                    for ahead in range(1, horizon + 1):
                        shown, now = frames[source + ahead if name == "true" else source], frames[source + ahead]
                        predicted = eddy.Frame(
                            shown.position, shown.velocity, shown.material, stream=now.stream, sequence=now.sequence,
                            time=now.time, dt=now.dt,
                        )  # fmt: skip
                        writer.write_prediction(predicted, source, model=name)
    given = {name: tmp_path / name for name in ("still", "true")}
    report = eddy.evaluate(bags, predictions=given, horizon=horizon, starts=2).to_dict()
    skill = {entry["name"]: entry["skill"] for entry in report["predictors"]}
    assert skill["true"] == [1.0] * horizon
    assert skill["still"] == skill["persistence"]
    model, *others = report["groups"]
    assert [group["name"] for group in others] == ["still", "true"]
    assert others[1]["gain"]["gain"] == pytest.approx([1.0 - of_model for of_model in model["skill"]])

    with eddy.BagWriter(tmp_path / "wrong") as writer, pytest.raises(ValueError, match="source_sequence: found 3, expected below 3"):
        writer.write_prediction(eddy.Frame(shown.position, shown.velocity, "jelly", sequence=3), 3)
    with pytest.raises(eddy.EvaluationError, match="still: .*found 5 frames predicted from sequence"):
        eddy.evaluate(bags, predictions={"still": tmp_path / "still"}, horizon=6, starts=2)


def test_an_exception_of_the_callback_ends_the_run(tmp_path: Path, bags: Path) -> None:
    def stop(epoch: object) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        eddy.train(bags, tmp_path / "model", {**SMALL, "epochs": 1000}, callback=stop)
    assert (tmp_path / "model" / "model.toml").exists(), "the epoch before is kept"


def test_ctrl_c_ends_a_run_and_keeps_its_epochs(tmp_path: Path, bags: Path) -> None:
    def interrupt(epoch: object) -> None:
        # As a terminal does, from outside of the main thread.
        threading.Thread(target=os.kill, args=(os.getpid(), signal.SIGINT)).start()

    with pytest.raises(KeyboardInterrupt):
        eddy.train(bags, tmp_path / "model", {**SMALL, "epochs": 1000}, callback=interrupt)
    assert (tmp_path / "model" / "model.toml").exists()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"epoch": 3}, "unknown field `epoch`"),
        ({"epochs": "many"}, "expected a whole number"),
        ({"epochs": 0}, "epochs: found 0"),
    ],
)
def test_wrong_settings_are_named(tmp_path: Path, bags: Path, config: dict[str, object], message: str) -> None:
    with pytest.raises(eddy.TrainError, match=message):
        eddy.train(bags, tmp_path / "model", config)


def test_the_papers_recipe_is_for_its_network(tmp_path: Path, bags: Path) -> None:
    with pytest.raises(eddy.TrainError, match="recipe: found paper for architecture particle"):
        eddy.train(bags, tmp_path / "model", {"architecture": "particle"}, recipe="paper")
    with pytest.raises(ValueError, match="recipe"):
        eddy.train(bags, tmp_path / "model", recipe="secret")  # type: ignore[arg-type]


def test_evaluation_names_what_is_wrong(tmp_path: Path, bags: Path) -> None:
    with pytest.raises(eddy.EvaluationError, match="model.toml"):
        eddy.evaluate(bags, tmp_path)
    with pytest.raises(ValueError, match="references: found magic, expected mpm or chaos"):
        eddy.evaluate(bags, references=["magic"])  # type: ignore[list-item]
    with pytest.raises(eddy.EvaluationError, match="starts: found 0"):
        eddy.evaluate(bags, starts=0)


def test_unusable_streams_are_named_or_left_out(tmp_path: Path, bags: Path, block: eddy.Frame) -> None:
    wide = eddy.Frame(block.position, block.velocity, "jelly", stream=77, upper=(2.0, 1.0))
    with eddy.BagWriter(tmp_path / "wide") as writer:
        writer.write_frame(wide)
    both = [bags, tmp_path / "wide"]
    with pytest.raises(eddy.EvaluationError, match="wide: stream 77, frame 0: lower, upper: .*; skip_streams=True"):
        eddy.evaluate(both, horizon=2, starts=1)
    with pytest.warns(UserWarning, match="skipped: .*wide: stream 77"):
        eddy.evaluate(both, horizon=2, starts=1, skip_streams=True)
