from collections.abc import Callable, Mapping, Sequence
from os import PathLike
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Protocol, TypedDict, final

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "Bag",
    "BagError",
    "BagWriter",
    "CheckpointError",
    "EddyError",
    "EvaluationError",
    "Frame",
    "Frames",
    "Message",
    "Messages",
    "Node",
    "NodeError",
    "Report",
    "Scene",
    "SimulationError",
    "Solver",
    "Stream",
    "Surrogate",
    "TrainError",
    "__version__",
    "evaluate",
    "evaluation_starts",
    "skill",
    "train",
]

__version__: str

class _DLPack(Protocol):
    def __dlpack__(self) -> object: ...
    def __dlpack_device__(self) -> tuple[int, int]: ...

_Array = NDArray[Any] | _DLPack
_Path = str | PathLike[str]
_Paths = _Path | Sequence[_Path]

class EddyError(Exception): ...
class BagError(EddyError): ...
class CheckpointError(EddyError): ...
class SimulationError(EddyError): ...
class EvaluationError(EddyError): ...
class TrainError(EddyError): ...
class NodeError(EddyError): ...

@final
class Frame:
    def __new__(
        cls,
        position: _Array,
        velocity: _Array,
        material: _Array | str,
        *,
        stream: int = 0,
        sequence: int = 0,
        time: float = 0.0,
        dt: float = 0.016,
        lower: Sequence[float] | None = None,
        upper: Sequence[float] | None = None,
    ) -> Frame: ...
    @property
    def position(self) -> NDArray[np.float32]: ...
    @property
    def velocity(self) -> NDArray[np.float32]: ...
    @property
    def material(self) -> NDArray[np.uint8]: ...
    @property
    def stream(self) -> int: ...
    @property
    def sequence(self) -> int: ...
    @property
    def time(self) -> float: ...
    @property
    def stamp(self) -> int: ...
    @property
    def dt(self) -> float: ...
    @property
    def lower(self) -> tuple[float, ...]: ...
    @property
    def upper(self) -> tuple[float, ...]: ...
    def check(self) -> None: ...
    def __len__(self) -> int: ...
    def __eq__(self, other: object, /) -> bool: ...

@final
class Scene:
    def __new__(cls, settings: dict[str, Any]) -> Scene: ...
    @staticmethod
    def generate(
        preset: Literal["kinds", "sand", "multi-material", "fluid", "stiff", "push", "pour", "scoop"],
        *,
        seed: int = 0,
        id: int = 0,
        particles: int | None = None,
    ) -> Scene: ...
    @staticmethod
    def load(path: _Path) -> Scene: ...
    def to_dict(self) -> dict[str, Any]: ...
    @property
    def duration(self) -> float: ...
    @property
    def dt(self) -> float: ...
    @property
    def domain(self) -> tuple[float, float]: ...
    def __eq__(self, other: object, /) -> bool: ...

class _Energy(TypedDict):
    kinetic: float
    elastic: float
    potential: float

class _ToolLoad(TypedDict):
    impulse: tuple[float, float]
    angular_impulse: float
    work: float

@final
class Solver:
    def __new__(
        cls,
        scene: Scene,
        *,
        stiffness: float | None = None,
        law: Literal["water", "settling", "taichi"] | None = None,
        viscosity: float | None = None,
        substeps: int | None = None,
        duration: float | None = None,
        threads: int = 1,
    ) -> Solver: ...
    def step(self) -> Frame | None: ...
    def __iter__(self) -> Solver: ...
    def __next__(self) -> Frame: ...
    def displace(self, by: _Array) -> None: ...
    def move_tools(self, poses: _Array) -> None: ...
    def tool_loads(self) -> list[_ToolLoad]: ...
    def energy(self) -> _Energy: ...
    @property
    def scene(self) -> Scene: ...
    @property
    def substeps(self) -> int: ...

@final
class Surrogate:
    def __new__(cls, checkpoint: _Path | None = None, *, threads: int | None = None) -> Surrogate: ...
    def stream(self, first: Frame, *, stiffness: float | None = None) -> Stream: ...
    def step(self, streams: Sequence[Stream], frames: Sequence[Frame]) -> list[Frame]: ...
    def warnings(self, first: Frame, *, stiffness: float | None = None) -> list[str]: ...
    @property
    def warm_up(self) -> int: ...
    @property
    def dt(self) -> float: ...
    @property
    def digest(self) -> str: ...
    @property
    def description(self) -> dict[str, Any]: ...

@final
class Stream:
    def step(self, frame: Frame) -> Frame: ...
    def step_arrays(
        self, position: _Array, velocity: _Array
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]: ...
    def rollout(self, frame: Frame, frames: int) -> list[Frame]: ...
    def copy(self) -> Stream: ...
    def forget(self) -> None: ...
    def __len__(self) -> int: ...

class _Topic(TypedDict):
    name: str
    type: str
    messages: int
    definition: str

class _Arrays(TypedDict):
    position: NDArray[np.float32]
    velocity: NDArray[np.float32]
    material: NDArray[np.uint8]
    sequence: NDArray[np.uint64]
    time: NDArray[np.float64]

class _Tools(TypedDict):
    tools: list[dict[str, Any]]
    sequence: NDArray[np.uint64]
    pose: NDArray[np.float32]
    twist: NDArray[np.float32]
    wrench: NDArray[np.float64]

@final
class Bag:
    def __new__(cls, path: _Path) -> Bag: ...
    @property
    def topics(self) -> list[_Topic]: ...
    @property
    def custom_data(self) -> dict[str, str]: ...
    def frames(self, topic: str = "/particles") -> Frames: ...
    def arrays(self, topic: str = "/particles", *, stream: int | None = None) -> _Arrays: ...
    def tools(self, topic: str = "/particles", *, stream: int | None = None) -> _Tools: ...
    def messages(
        self,
        topics: str | Sequence[str] | None = None,
        *,
        start: int | None = None,
        end: int | None = None,
    ) -> Messages: ...
    @property
    def start(self) -> int | None: ...
    @property
    def end(self) -> int | None: ...
    @property
    def damage(self) -> str | None: ...
    @property
    def path(self) -> PathLike[str]: ...
    def __len__(self) -> int: ...

@final
class Frames:
    def __iter__(self) -> Frames: ...
    def __next__(self) -> Frame: ...

@final
class Messages:
    def __iter__(self) -> Messages: ...
    def __next__(self) -> Message: ...

@final
class Message:
    @property
    def topic(self) -> str: ...
    @property
    def type(self) -> str: ...
    @property
    def log_time(self) -> int: ...
    @property
    def publish_time(self) -> int: ...
    @property
    def data(self) -> bytes: ...

@final
class BagWriter:
    def __new__(
        cls,
        path: _Path,
        *,
        compression: Literal["none", "lz4", "zstd"] = "zstd",
        custom_data: Mapping[str, str] | None = None,
    ) -> BagWriter: ...
    def write_frame(
        self, frame: Frame, topic: str = "/particles", *, log_time: int | None = None
    ) -> None: ...
    def write_tools(
        self,
        frame: Frame,
        tools: Sequence[Mapping[str, Any]],
        pose: _Array,
        topic: str = "/particles",
        *,
        twist: _Array | None = None,
        wrench: _Array | None = None,
    ) -> None: ...
    def write_prediction(
        self, frame: Frame, source_sequence: int, topic: str = "/prediction", *, model: str = ""
    ) -> None: ...
    def write(
        self,
        topic: str,
        type: str,
        data: bytes,
        *,
        definition: str | None = None,
        log_time: int | None = None,
        publish_time: int | None = None,
    ) -> None: ...
    def close(self) -> int: ...
    def __enter__(self) -> BagWriter: ...
    def __exit__(
        self,
        *_error: type[BaseException] | BaseException | TracebackType | None,
    ) -> bool: ...

@final
class Report:
    def to_dict(self) -> dict[str, Any]: ...
    def tables(self, columns: int = 80) -> str: ...
    def save(self, folder: _Path) -> None: ...

class _Starts(TypedDict):
    bag: Path
    stream: int
    sequences: list[int]

class _Epoch(TypedDict):
    epoch: int
    samples: int
    unroll: int
    training_loss: float
    validation_loss: float
    first_skill: float
    last_skill: float
    learning_rate: float
    weight_distance: float
    epsilon_share: float
    best: bool

class _Outcome(TypedDict):
    epochs: list[_Epoch]
    seconds: float
    samples: int
    digest: str | None

def evaluate(
    data: _Paths,
    checkpoints: _Paths | None = None,
    *,
    predictions: Mapping[str, _Path] = ...,
    horizon: int = 100,
    starts: int = 7,
    stiffness: float | None = None,
    references: Sequence[Literal["mpm", "chaos"]] = ...,
    threads: int | None = None,
    skip_streams: bool = False,
) -> Report: ...
def evaluation_starts(
    data: _Paths,
    checkpoints: _Paths | None = None,
    *,
    horizon: int = 100,
    starts: int = 7,
    stiffness: float | None = None,
    skip_streams: bool = False,
) -> list[_Starts]: ...
def skill(
    starts: Sequence[Frame],
    truth: _Array,
    predicted: _Array,
    *,
    gravity: Sequence[float] = ...,
) -> NDArray[np.float64]: ...
def train(
    data: _Paths,
    output: _Path,
    config: dict[str, Any] | _Path | None = None,
    *,
    start: _Path | None = None,
    recipe: Literal["default", "paper"] = "default",
    device: str = "auto",
    precision: Literal["tf32", "fp32"] = "tf32",
    resume: bool = False,
    callback: Callable[[_Epoch], object] | None = None,
    skip_streams: bool = False,
) -> _Outcome: ...

class _NodeStatus(TypedDict):
    rate: float
    latency_p50: float
    latency_p99: float
    streams: int

@final
class Node:
    def __new__(
        cls,
        input: str = "zenoh:particles",
        output: str | Sequence[str] = "zenoh:prediction",
        surrogate: Surrogate | _Path | None = None,
        *,
        settings: dict[str, bool | int | float | str] | None = None,
        reliability: Literal["block", "drop"] = "drop",
        name: str = "eddy_node",
        namespace: str = "/",
    ) -> Node: ...
    def start(self) -> None: ...
    def stop(self) -> None: ...
    def wait(self, timeout: float | None = None) -> bool: ...
    def set(self, settings: dict[str, bool | int | float | str]) -> None: ...
    def reset(self) -> int: ...
    @property
    def running(self) -> bool: ...
    @property
    def settings(self) -> dict[str, bool | int | float | str]: ...
    @property
    def counters(self) -> dict[str, int]: ...
    @property
    def status(self) -> _NodeStatus: ...
    @property
    def input(self) -> str: ...
    @property
    def outputs(self) -> list[str]: ...
    @property
    def name(self) -> str: ...
    def __enter__(self) -> Node: ...
    def __exit__(
        self,
        *_error: type[BaseException] | BaseException | TracebackType | None,
    ) -> bool: ...
