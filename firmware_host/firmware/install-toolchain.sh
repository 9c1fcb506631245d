#!/bin/sh
# Installs what the firmware's tests need, where it is missing: compilers, make, cppcheck, libFuzzer.
# Without root or apt it says what to install and ends well; the tests then skip and say so.
set -eu

packages=""
need() {
    command -v "$1" >/dev/null 2>&1 || packages="$packages $2"
}
need cc "gcc libc6-dev"
need c++ g++
need make make
need arm-none-eabi-gcc gcc-arm-none-eabi
need cppcheck cppcheck
need clang clang

fuzzer_missing() {
    ! printf 'int LLVMFuzzerTestOneInput(const char *d, unsigned long n) { return d && n > 9; }' |
        clang -fsanitize=fuzzer -x c - -o /dev/null >/dev/null 2>&1
}

install() {
    if [ "$(id -u)" != 0 ] || ! command -v apt-get >/dev/null 2>&1; then
        echo "firmware tests will be skipped; as root: apt-get install --no-install-recommends$1" >&2
        exit 0
    fi
    # An apt that fails (no network, a lock) must not fail the tests of everything else.
    apt-get update -qq >/dev/null 2>&1 || true
    # shellcheck disable=SC2086 # a list of packages
    if ! DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $1 >/dev/null; then
        echo "firmware tests will be skipped; this failed: apt-get install --no-install-recommends$1" >&2
        exit 0
    fi
}

if [ -n "$packages" ]; then
    echo "installing$packages"
    install "$packages"
fi
# libFuzzer's package carries clang's version in its name, so clang must be there to ask.
if fuzzer_missing; then
    version=$(clang -dumpversion | cut -d. -f1)
    echo "installing libclang-rt-$version-dev"
    install " libclang-rt-$version-dev"
fi
