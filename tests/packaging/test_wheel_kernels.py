"""A wheel takes the kernels that were compiled for it, an editable installation none."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


def test_a_wheel_holds_what_was_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    hook = module.Kernels(str(tmp_path), {}, None, None, str(tmp_path), "wheel")
    data: dict[str, Any] = {"force_include": {}}
    hook.initialize("standard", data)
    assert not data["force_include"]
    built = tmp_path / "build" / "kernels" / "some.bin"
    built.parent.mkdir(parents=True)
    built.write_bytes(b"")
    hook.initialize("standard", data)
    assert not data["force_include"]
    monkeypatch.setenv("EVLCP_KERNELS", "build/kernels")
    hook.initialize("editable", data)
    assert not data["force_include"]
    hook.initialize("standard", data)
    assert data["force_include"] == {str(built): "evlcp_sdk/data/kernels/some.bin"}
