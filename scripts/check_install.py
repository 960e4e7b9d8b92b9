"""Checks an installed ir_maniskill: everything comes from there, and a task steps."""

from __future__ import annotations

import sys
from importlib import resources
from pathlib import Path

import gymnasium as gym


def main(prefix: Path) -> None:
    """Check that all comes from this folder, nothing from a checkout, and step."""
    assert "ir_maniskill" not in sys.modules
    env = gym.make(
        "ir_maniskill:NaoTouchCubeSingle-v1",
        obs_mode="rgb",
        sensor_configs={"width": 64, "height": 128},
    )
    for name, module in sorted(sys.modules.items()):
        if name.partition(".")[0] == "ir_maniskill" and module.__file__:
            assert Path(module.__file__).resolve().is_relative_to(prefix), module
    assert "ir_maniskill.tasks" in sys.modules, "the tasks were not imported"
    urdf = Path(str(resources.files("ir_maniskill.assets") / "nao" / "nao.urdf"))
    assert urdf.is_file() and urdf.resolve().is_relative_to(prefix), urdf
    assert any(urdf.parent.rglob("*.glb")), f"no meshes beside {urdf}"

    from ir_maniskill.language.lexicon import lexicon

    shares = lexicon(("<pad>", "<unk>", "red", "blue")).read("crimson")
    assert next(iter(shares), None) == "red", shares

    observation, _ = env.reset(seed=0)
    for camera in ("top_camera", "front_camera"):
        picture = observation["sensor_data"][camera]["rgb"]
        assert tuple(picture.shape) == (1, 128, 64, 3), picture.shape
        assert float(picture.float().std()) > 1, f"{camera} sees nothing"
    _, reward, *_, info = env.step(env.action_space.sample())
    assert reward.shape == (1,) and "success" in info
    assert "Touch the" in env.unwrapped.get_language_instruction()[0]
    env.close()
    print(f"The installed wheel works: {prefix}")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
