"""A LeRobotDataset of version 3.0, in which the sentences are the tasks.

Legend: J joints, F fingers, H x W pixels, T frames, D numbers.
"""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pyarrow
from PIL import Image
from pyarrow import parquet
from torch import Tensor

from ir_maniskill.environment.senses import Observation, cameras
from ir_maniskill.environment.touch_env import CONTROL_FREQ
from ir_maniskill.files import write_json

CHUNK = 500
"""Episodes in each file."""

DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Where frames are."""

EPISODES = "meta/episodes/chunk-000/file-000.parquet"
"""Where it says which frames an episode has."""

PANDAS = {
    "index_columns": ["task"],
    "column_indexes": [],
    "columns": [
        {"name": "task", "field_name": "task", "metadata": None}
        | {"pandas_type": "unicode", "numpy_type": "object"}
    ],
}
"""Says that the sentences are the index of the tasks, which LeRobot reads by pandas."""


class LeRobotWriter:
    """Writes frames to parquet files, and at the end what is known of all."""

    def __init__(
        self, folder: Path, env_id: str, height: int, env_kwargs: dict[str, Any]
    ) -> None:
        self._folder = folder
        self.env = gym.make(env_id, **env_kwargs)
        # A second env draws: the policy's own pictures are too small for others.
        size = {"height": height, "width": height // 2}
        drawn = {**env_kwargs, "obs_mode": "rgb", "sensor_configs": size}
        self._drawn: Any = gym.make(env_id, **drawn).unwrapped
        robot: Any = self.env.unwrapped.agent  # type: ignore[attr-defined]
        joints, fingers = list(robot.joints), list(robot.fingers)
        views = cameras(self._drawn.reset(seed=0)[0])
        self._views = [f"observation.images.{view}" for view in views]
        picture = _feature("image", (height, height // 2, 3), [*"HWC"])
        self._robot = robot.uid
        self._features = {
            **dict.fromkeys(self._views, picture),
            "observation.state": _feature("float32", (len(joints),), joints),
            "observation.touch": _feature("float32", (len(fingers),), fingers),
            "action": _feature("float32", (len(joints),), joints),
            "next.reward": _feature("float32"),
            "next.success": _feature("bool"),
            "next.done": _feature("bool"),
            "timestamp": _feature("float32"),
            "frame_index": _feature("int64"),
            "episode_index": _feature("int64"),
            "index": _feature("int64"),
            "task_index": _feature("int64"),
        }
        self._statistics = {name: _Statistics() for name in self._features}
        self._frames: list[dict[str, Any]] = []
        self._episodes: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._file: Any = None

    def step(self, obs: Observation, action: Tensor) -> tuple:
        """Draw and step the env, and keep what was seen, felt and done."""
        base: Any = self.env.unwrapped
        self._drawn.set_state_dict(base.get_state_dict())
        seen = self._drawn.get_obs()["sensor_data"]
        then = self.env.step(action)
        _, reward, _, truncated, info = then
        frame = {
            **{f"observation.images.{view}": seen[view]["rgb"] for view in seen},
            "observation.state": obs["agent"]["proprioception"],
            "observation.touch": obs["extra"]["touch"],
            "action": action,
            "next.reward": reward,
            "next.success": info["success"],
            "next.done": truncated,
        }
        rows = {name: value[0].numpy(force=True) for name, value in frame.items()}
        self._frames.append({k: v if v.ndim else v.item() for k, v in rows.items()})
        return then

    def end(self, sentence: str, kept: bool) -> None:
        """Write the frames of the episode, or drop them."""
        frames, self._frames = self._frames, []
        if not kept:
            return
        episode, first = len(self._episodes), self._count
        task = self._tasks.setdefault(sentence, len(self._tasks))
        for index, frame in enumerate(frames):
            frame |= {
                "timestamp": index / CONTROL_FREQ,
                "frame_index": index,
                "episode_index": episode,
                "index": first + index,
                "task_index": task,
            }
        for name in self._features:
            self._statistics[name].add(np.stack([frame[name] for frame in frames]))
        for frame in frames:
            frame |= {view: {"bytes": _png(frame[view])} for view in self._views}
        table = pyarrow.Table.from_pylist(frames, self._schema)
        self._file_of(episode).write_table(table)
        self._episodes.append(
            {
                "episode_index": episode,
                "tasks": [sentence],
                "length": len(frames),
                "dataset_from_index": first,
                "dataset_to_index": first + len(frames),
                "data/chunk_index": 0,
                "data/file_index": episode // CHUNK,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )

    @property
    def _count(self) -> int:
        """Frames that were kept."""
        return self._episodes[-1]["dataset_to_index"] if self._episodes else 0

    def _file_of(self, episode: int) -> Any:
        """Return the open file to which an episode goes."""
        if episode % CHUNK == 0:
            if self._file is not None:
                self._file.close()
            path = self._folder / DATA.format(
                chunk_index=0, file_index=episode // CHUNK
            )
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = parquet.ParquetWriter(path, self._schema)
        return self._file

    @property
    def _schema(self) -> Any:
        """The columns' types in the parquet files."""
        picture = {"bytes": pyarrow.binary(), "path": pyarrow.string()}
        fields = {}
        for name, feature in self._features.items():
            (size, *_), kind = feature["shape"], feature["dtype"]
            if kind == "image":
                fields[name] = pyarrow.struct(picture)
            else:
                one = pyarrow.type_for_alias(kind)
                fields[name] = pyarrow.list_(one, size) if size > 1 else one
        return pyarrow.schema(fields)

    def close(self) -> None:
        """Write what is known of all episodes."""
        self.env.close()
        self._drawn.close()
        if self._file is None:
            return
        self._file.close()
        meta, episodes = self._folder / "meta", self._folder / EPISODES
        episodes.parent.mkdir(parents=True)
        parquet.write_table(pyarrow.Table.from_pylist(self._episodes), episodes)
        tasks = {"task_index": [*self._tasks.values()], "task": [*self._tasks]}
        table = pyarrow.table(tasks)
        table = table.replace_schema_metadata({"pandas": json.dumps(PANDAS)})
        parquet.write_table(table, meta / "tasks.parquet")
        found = {name: known.as_dict() for name, known in self._statistics.items()}
        write_json(meta / "stats.json", found)
        count = len(self._episodes)
        write_json(
            meta / "info.json",
            {
                "codebase_version": "v3.0",
                "robot_type": self._robot,
                "total_episodes": count,
                "total_frames": self._count,
                "total_tasks": len(self._tasks),
                "chunks_size": 1000,
                "data_files_size_in_mb": 100,
                "video_files_size_in_mb": 200,
                "fps": CONTROL_FREQ,
                "splits": {"train": f"0:{count}"},
                "data_path": DATA,
                "video_path": None,
                "features": self._features,
            },
        )


def _feature(
    dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None
) -> dict[str, Any]:
    """Return what a LeRobotDataset says of a column."""
    return {"dtype": dtype, "shape": list(shape), "names": names}


def _png(picture: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "png")
    return file.getvalue()


class _Statistics:
    """Mean, spread and range of what is added [D]; of pictures by channel, 0 to 1."""

    def __init__(self) -> None:
        self.count = 0
        self._low: Any = np.inf
        self._high: Any = -np.inf
        self._sum: Any = 0.0
        self._squares: Any = 0.0

    def add(self, values: np.ndarray) -> None:
        """Add frames: numbers [T] or [T, D], or pictures [T, H, W, 3] uint8."""
        self.count += len(values)
        self._picture = values.ndim == 4
        numbers = values.astype(np.float64) / (255 if self._picture else 1)
        numbers = numbers.reshape(-1, values.shape[-1] if values.ndim > 1 else 1)
        self._low = np.minimum(self._low, numbers.min(axis=0))
        self._high = np.maximum(self._high, numbers.max(axis=0))
        share = len(numbers) / len(values)  # pixels of a frame
        self._sum = self._sum + numbers.sum(axis=0) / share
        self._squares = self._squares + (numbers**2).sum(axis=0) / share

    def as_dict(self) -> dict[str, Any]:
        """Return them as a LeRobotDataset has them."""
        mean = self._sum / self.count
        spread = np.sqrt(np.maximum(self._squares / self.count - mean**2, 0))
        found = {"min": self._low, "max": self._high, "mean": mean, "std": spread}
        shape = (-1, 1, 1) if self._picture else (-1,)
        listed = {name: value.reshape(shape).tolist() for name, value in found.items()}
        return {**listed, "count": [self.count]}
