"""Makes policy.safetensors and expected.csv beside it: a small policy, and what numpy says that it does.

    python fixture.py        # wants numpy; the file's format is written by hand, so that nothing else is needed
"""

import json
import struct
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent


def save(path: Path, tensors: dict[str, np.ndarray], metadata: dict[str, str]) -> None:
    header: dict[str, object] = {"__metadata__": metadata}
    offset = 0
    for name, tensor in tensors.items():
        kind = {"float32": "F32", "float64": "F64"}[str(tensor.dtype)]
        header[name] = {
            "dtype": kind,
            "shape": list(tensor.shape),
            "data_offsets": [offset, offset + tensor.nbytes],
        }
        offset += tensor.nbytes
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    data = b"".join(tensor.tobytes() for tensor in tensors.values())
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


def main() -> None:
    random = np.random.default_rng(5)
    widths = [3, 16, 16, 1]
    layers = list(zip(widths[:-1], widths[1:], strict=True))
    weights = [random.normal(0, 1 / np.sqrt(i), (o, i)).astype(np.float32) for i, o in layers]
    biases = [random.normal(0, 0.3, o).astype(np.float32) for _, o in layers]
    mean, std = np.array([0.1, -0.2, 0.5]), np.array([0.7, 0.6, 5.0])
    scale, offset, low, high = 4.0, 0.25, -3.0, 3.5
    tensors = {}
    for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        tensors[f"layers.{index}.weight"] = weight
        tensors[f"layers.{index}.bias"] = bias
    metadata = {
        "format": "parallax-policy-1",
        "activation": "swish",
        "output_activation": "tanh",
        "observations": json.dumps(["cos(angle)", "sin(angle)", "speed"]),
        "actions": json.dumps(["voltage"]),
        "observation_mean": json.dumps(mean.tolist()),
        "observation_std": json.dumps(std.tolist()),
        "observation_clip": "2.5",
        "action_scale": json.dumps([scale]),
        "action_offset": json.dumps([offset]),
        "action_low": json.dumps([low]),
        "action_high": json.dumps([high]),
    }
    save(HERE / "policy.safetensors", tensors, metadata)

    lines = ["angle,speed,voltage"]
    for _ in range(50):
        angle, speed = random.uniform(-np.pi, np.pi), random.normal(0, 8)
        x = np.clip((np.array([np.cos(angle), np.sin(angle), speed]) - mean) / std, -2.5, 2.5)
        for index, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = weight.astype(np.float64) @ x + bias.astype(np.float64)
            x = np.tanh(x) if index == len(weights) - 1 else x / (1 + np.exp(-x))
        voltage = np.clip(x[0] * scale + offset, low, high)
        lines.append(f"{angle!r},{speed!r},{voltage!r}".replace("np.float64(", "").replace(")", ""))
    (HERE / "expected.csv").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
