"""Joint position targets: how an action becomes what the drives follow.

Legend: N envs, J joints.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from mani_skill.agents.controllers import (
    PDJointPosController,
    PDJointPosControllerConfig,
)
from torch import Tensor


class TargetController(PDJointPosController):
    """Joint position targets, kept within the limits, absolute or changed by a delta.

    Three differences from its parent: targets never leave the joints' limits, numbers
    that don't change are computed once, and a reset keeps the targets of other envs and
    those of a restored state.
    """

    config: PDJointPosControllerConfig
    _stale: Tensor | None = None
    """During a reset of the env: whose targets `reset` must set anew [N] bool."""

    def _initialize_joints(self) -> None:
        super()._initialize_joints()
        limits = self.articulation.get_qlimits()[0, self.active_joint_indices]
        self.lower, self.upper = limits.unbind(-1)  # [J] [rad]
        self._physx_joints = [joint._objs[0] for joint in self.joints]

    def _clip_and_scale_action_space(self) -> None:
        super()._clip_and_scale_action_space()
        low, high = self.action_space_low, self.action_space_high  # [J] [rad]
        self._action_middle, self._action_scale = 0.5 * (high + low), 0.5 * (high - low)

    def _clip_and_scale_action(self, action: Tensor) -> Tensor:
        return self._action_middle + self._action_scale * action.clamp(-1, 1)

    @property
    def target(self) -> Tensor:
        """Current joint position targets [N, J] [rad]; before any, the positions."""
        return self.qpos if self._target_qpos is None else self._target_qpos

    def set_action(self, action: Tensor) -> None:
        """Set the targets, or change them if the config says `use_delta`.

        Args:
            action: In the order of `config.joint_names` [N, J] in [-1, 1].
        """
        angle = self._preprocess_action(action)
        self.set_drive_targets(self.target + angle if self.config.use_delta else angle)

    def action_for(self, targets: Tensor) -> Tensor:
        """Return the action, as far as it goes, that sets these targets [N, J]."""
        angle = targets - self.target if self.config.use_delta else targets
        return ((angle - self._action_middle) / self._action_scale).clamp(-1, 1)

    def set_drive_targets(self, targets: Tensor) -> None:
        """Send targets to the simulator.

        Args:
            targets: Positions in the order of `config.joint_names` [N, J] [rad].
        """
        targets = targets.clamp(self.lower, self.upper)
        if self.scene.gpu_sim_enabled:
            # Of a batch ManiSkill takes the rows of the envs being reset alone.
            super().set_drive_targets(targets[self.scene._reset_mask])
        else:
            (angles,) = targets.tolist()
            for joint, angle in zip(self._physx_joints, angles, strict=True):
                joint.set_drive_target(angle)
        self._target_qpos = targets

    def begin_reset(self) -> None:
        """Remember which envs are reset: ManiSkill forgets it before `reset`."""
        self._stale = self.scene._reset_mask.clone()

    def reset(self) -> None:
        """Make the current positions the targets.

        Within a reset of the env: of the envs being reset, unless `set_state` has
        restored their targets since.
        """
        everyone = self.scene._reset_mask
        if self._stale is not None:
            self.scene._reset_mask, self._stale = self._stale, None
        super().reset()
        self.scene._reset_mask = everyone
        self.set_drive_targets(self._target_qpos)

    def get_state(self) -> dict[str, Tensor]:
        """Return the targets: they are state in every control mode."""
        return {"target_qpos": self.target.clone()}

    def set_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `get_state` returned."""
        self.set_drive_targets(state["target_qpos"])
        if self._stale is not None:
            self._stale = torch.zeros_like(self._stale)


@dataclass
class TargetControllerConfig(PDJointPosControllerConfig):
    """Config of `TargetController`; the fields are its parent's."""

    controller_cls = TargetController
