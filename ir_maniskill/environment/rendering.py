"""RenderedEnv: a ManiSkill env whose policy cameras are drawn and read quickly.

On the CPU a software renderer draws on other cores while contacts are judged, and
pictures are handed on without copies. ManiSkill's own way serves all other modes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS
from mani_skill.sensors.camera import Camera
from torch import Tensor


class RenderedEnv(BaseEnv):
    """Overrides of `BaseEnv` that have to do with pictures alone."""

    _colors_only = False  # without a renderer no sensors are set up
    _drawing = False  # whether pictures of this very state are under way

    def _setup_sensors(self, options: dict) -> None:
        # Picture formats are global: a video camera made earlier leaves floats behind.
        sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
        try:
            super()._setup_sensors(options)
        except KeyError as error:
            known = ", ".join(PREBUILT_SHADER_CONFIGS)
            raise ValueError(f"shader_pack: got {error}, available: {known}") from None
        self._sensor_params: dict | None = None
        wanted = {kind for kind, on in vars(self.obs_mode_struct.visual).items() if on}
        self._colors_only = wanted == {"rgb"} and not self._sim_device.is_cuda()
        for name, sensor in self._sensors.items():
            pack = sensor.config.shader_config
            drawn = {kind for kinds in pack.texture_names.values() for kind in kinds}
            if not wanted <= drawn:
                raise ValueError(
                    f"obs_mode: got {self.obs_mode!r}, but the shader pack of {name} "
                    f"draws only {', '.join(sorted(drawn))}; choose another shader_pack"
                )

    def _after_control_step(self) -> None:
        if self._colors_only:
            self._draw_pictures()
            self._drawing = True

    def _draw_pictures(self) -> None:
        """Have the renderer begin with what all sensors see, and do not wait."""
        self.scene.update_render(update_sensors=True, update_human_render_cameras=False)
        self.capture_sensor_data()

    def _get_obs_with_sensor_data(
        self, info: dict[str, Tensor], apply_texture_transforms: bool = True
    ) -> dict:
        """Observe; within a step pictures come last, in `_flatten_raw_obs`."""
        if not self._drawing:
            if not self.scene.can_render():
                raise ValueError(
                    f"obs_mode: got {self.obs_mode!r} with the render_backend 'none', "
                    "expected one without pictures (state, state_dict, none)"
                )
            return super()._get_obs_with_sensor_data(info, apply_texture_transforms)
        return {
            "agent": self._get_obs_agent(),
            "extra": self._get_obs_extra(info),
            "sensor_param": self.get_sensor_params(),
            "sensor_data": {},
        }

    def _flatten_raw_obs(self, obs: Any) -> Any:
        """Fetch pictures under way; flatten as ManiSkill does, but all at once."""
        if self._drawing:
            obs["sensor_data"] = self._get_obs_sensor_data()
        if not self.obs_mode_struct.state:
            return obs
        leaves = [*obs.pop("agent").values(), *obs.pop("extra").values()]
        flat = torch.cat([leaf.flatten(1) for leaf in leaves], dim=1)
        return flat if self.obs_mode == "state" else obs | {"state": flat}

    def _get_obs_sensor_data(self, apply_texture_transforms: bool = True) -> dict:
        drawing, self._drawing = self._drawing, False
        if not (self._colors_only and apply_texture_transforms):
            return super()._get_obs_sensor_data(apply_texture_transforms)
        if not drawing:
            self._draw_pictures()
        sensors = self.scene.sensors.items()
        return {name: _fetch_color(sensor) for name, sensor in sensors}

    def get_sensor_params(self) -> dict:
        """Return copies of the cameras' matrices, computed once if no camera moves."""
        moving = any(sensor.camera.mount for sensor in self._sensors.values())
        if self._sensor_params is None or moving:
            self._sensor_params = super().get_sensor_params()
        return {
            name: {key: matrix.clone() for key, matrix in matrices.items()}
            for name, matrices in self._sensor_params.items()
        }


def _fetch_color(sensor: Camera) -> dict[str, Tensor]:
    """Return the picture that `sensor` drew, as its `get_obs` but not copied.

    Torch copies even small pictures on all cores, which wait for each other.
    """
    (camera,) = sensor.camera._render_cameras
    color = camera.get_picture("Color")[None]  # [1, H, W, 4]
    if color.dtype == np.uint8:  # NumPy cuts alpha off in less time than torch
        return {"rgb": torch.from_numpy(color[..., :3])}
    transform = sensor.config.shader_config.texture_transforms["Color"]
    return transform(torch.from_numpy(color))
