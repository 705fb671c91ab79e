#!/usr/bin/env bash
# The Python package in this checkout: scripts/python.sh build | test [ARGUMENTS OF pytest]
# build puts the module into python/tce, for PYTHONPATH=python; test does that and runs the package's tests in a virtual environment of its own.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/common.sh

build() {
  need cargo python3 cc
  # The whole workspace: a build of one package would compile burn with other features, again.
  cargo build --release --locked --workspace
  install_file 755 "$(metadata "m['target_directory']")/release/lib_tce.so" python/tce/_tce.abi3.so
}

case ${1:-} in
  build) build ;;
  test)
    shift
    build
    venv=target/venv
    # Made anew when the list of packages changes.
    if ! cmp -s pyproject.toml "$venv/pyproject.toml"; then
      python3 -m venv --clear "$venv"
      "$venv/bin/python" -m pip install --quiet --upgrade 'pip>=25.1'
      "$venv/bin/python" -m pip install --quiet --group test
      cp pyproject.toml "$venv/pyproject.toml"
    fi
    PYTHONPATH=python "$venv/bin/python" -m mypy
    PYTHONPATH=python "$venv/bin/python" -m pytest "$@"
    ;;
  *)
    sed -n '2,3s/^# //p' scripts/python.sh
    [ -n "${1:-}" ] && [ "$1" != -h ] && [ "$1" != --help ] && exit 2
    exit 0
    ;;
esac
