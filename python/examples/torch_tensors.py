"""PyTorch tensors in and out of a surrogate, without a copy.

    pip install torch==2.15.0
    python torch_tensors.py

The arguments of `Stream.step_arrays` are read in place through the DLPack protocol; its results become tensors by
`torch.from_dlpack`. Here, tensors measure how far the surrogate is from the solver.
"""

import eddy
import torch


def rollout(stream: eddy.Stream, position: torch.Tensor, velocity: torch.Tensor, frames: int) -> torch.Tensor:
    """Predicted positions, float32 [frames, N, 2], from the last observed state."""
    predicted = []
    for _ in range(frames):
        arrays = stream.step_arrays(position, velocity)
        position, velocity = (torch.from_dlpack(array) for array in arrays)
        assert position.data_ptr() == arrays[0].ctypes.data, "the tensor is the array"
        predicted.append(position)
    return torch.stack(predicted)


def main() -> None:
    frames = list(eddy.Solver(eddy.Scene.generate("kinds", seed=1, id=2), duration=0.8))
    # Copies: the arrays of a frame are read-only, which tensors cannot be.
    position = torch.stack([torch.tensor(frame.position) for frame in frames])
    velocity = torch.stack([torch.tensor(frame.velocity) for frame in frames])
    observed, ahead = 20, 20
    stream = eddy.Surrogate(threads=1).stream(frames[0])
    for number in range(observed - 1):
        stream.step_arrays(position[number], velocity[number])
    predicted = rollout(stream, position[observed - 1], velocity[observed - 1], ahead)
    error = (predicted - position[observed : observed + ahead]).square().sum(-1).mean(-1).sqrt()
    for number in (1, 5, 10, 20):
        print(f"error {number:2} frames ahead: {error[number - 1]:.4f} domain lengths")


if __name__ == "__main__":
    main()
