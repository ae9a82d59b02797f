"""Writes the Parquet files that the tests of `parallax import` read, by `pandas` and `pyarrow`.

Usage: make_tables.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

folder = Path(sys.argv[1])
count = 100
seconds = np.arange(count) * 0.01

# As pandas writes a frame with an index of times, with a hole, and with text beside.
position = np.sin(seconds)
position[7] = np.nan
frame = pd.DataFrame(
    {
        "u [V]": np.cos(seconds),
        "pos [deg]": position,
        "n": np.arange(count, dtype="int64"),
        "mode": "run",
    },
    index=pd.DatetimeIndex(
        pd.to_datetime(1_700_000_000_000_000_001 + np.arange(count) * 10_000_000),
        name="time",
    ),
)
frame.to_parquet(folder / "frame.parquet")

# As data sets of robots' episodes are: lists of fixed size, compressed by zstd.
lists = pa.list_(pa.float32(), 2)
table = pa.table(
    {
        "observation.state": pa.array(
            [[2.0 * k, -float(k)] for k in range(count)], type=lists
        ),
        "action": pa.array([[0.5 * k, 1.0] for k in range(count)], type=lists),
        "timestamp": pa.array(seconds.astype("float32")),
        "frame_index": pa.array(range(count), type=pa.int64()),
    }
)
pq.write_table(table, folder / "episode.parquet", compression="zstd")
