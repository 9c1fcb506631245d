"""The firmware itself: builds without warnings, lint, C unit tests under sanitizers, fuzzing."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from board_lines import needs

from firmware_host import build
from tests.firmware.conftest import SANITIZED

TESTS = Path(__file__).parent / "c" / "Makefile"


def run(*command, timeout=300):
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)


def make(folder, *targets):
    return run("make", "-s", "-C", str(build.FIRMWARE), "-f", str(TESTS), f"BUILD={folder}", *targets)


def test_requests_under_sanitizers(tmp_path):
    done = make(tmp_path, "sanitized")
    assert done.returncode == 0, done.stderr
    environment = os.environ | {
        SANITIZED: str(tmp_path / "libevlcp-sanitized.so"),
        "LD_PRELOAD": run(os.environ.get("CC", "cc"), "-print-file-name=libasan.so").stdout.strip(),
        "ASAN_OPTIONS": "detect_leaks=0",
    }
    tests = [str(Path(__file__).with_name(f"test_board_{name}.py")) for name in ("requests", "light", "step")]
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-n", "0", "-k", "not stm32", *tests]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_fuzzer_finds_no_fault(tmp_path):
    needs("clang")
    probe = tmp_path / "probe.c"
    probe.write_text("int LLVMFuzzerTestOneInput(const char *d, unsigned long n) { return d && n > 9; }")
    if run("clang", "-fsanitize=fuzzer", str(probe), "-o", str(tmp_path / "probe")).returncode:
        pytest.skip("clang has no libFuzzer: sh firmware_host/firmware/install-toolchain.sh installs it")
    done = make(tmp_path, "fuzz", "FUZZ_SECONDS=60", "FUZZ_RUNS=6000")
    assert done.returncode == 0, done.stderr[-2000:]
    executed = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    assert executed
    assert int(executed[1]) >= 6_000


def test_lint():
    needs("cppcheck")
    done = make(Path("unused"), "lint")
    assert done.returncode == 0, done.stdout + done.stderr


def test_arm_images_build_without_warnings(tmp_path):
    needs("arm-none-eabi-gcc", "arm-none-eabi-nm")
    done = make(tmp_path, "stm32")
    assert (done.returncode, done.stderr) == (0, "")
    size = run("arm-none-eabi-size", str(tmp_path / "stm32f405.elf")).stdout.split()
    text, data, bss = (int(n) for n in size[6:9])
    assert text < 64 * 1024
    assert data + bss < 120 * 1024
    code = run("arm-none-eabi-objdump", "-d", str(tmp_path / "stm32f405.elf")).stdout
    # no sleep while chips play, and no call into a C library
    assert not re.search(r"\bwf[ie]\b", code)
    names = run("arm-none-eabi-nm", str(tmp_path / "stm32f405.elf")).stdout
    assert not re.search(r" [Tt] (malloc|printf|free)$", names, re.M)


def test_core_calls_only_the_hal(tmp_path):
    core = sorted((build.FIRMWARE / "core").glob("*.c"))
    made = str(tmp_path / "core.o")
    flags = ["-std=c11", "-ffreestanding", "-O2", "-Wall", "-Wextra", "-Werror", "-nostdlib", "-r", "-o"]
    include = [f"-I{build.FIRMWARE / folder}" for folder in ("core", "generated")]
    done = run(os.environ.get("CC", "cc"), *flags, made, *include, *map(str, core))
    assert done.returncode == 0, done.stderr
    outside = {line.split()[-1] for line in run("nm", "-u", made).stdout.splitlines()}
    # struct copies may become calls of these two; each HAL brings them along
    assert {n for n in outside if not n.startswith("hal_")} <= {"memcpy", "memset"}
    hal = {n for n in outside if n.startswith("hal_")}
    header = (build.FIRMWARE / "core" / "hal.h").read_text()
    assert hal == set(re.findall(r"\b(hal_\w+)\(", header))
    assert len(hal) == 18
