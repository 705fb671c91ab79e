#!/usr/bin/env bash
# Builds tce and puts it in place: scripts/install.sh [PREFIX] [ARGUMENTS OF cargo build, such as --features vulkan]
# makes PREFIX/bin/tce, PREFIX/lib/libmujoco.so.3.17.0, and manual pages and completions under PREFIX/share (default: ~/.local).
# bin and lib may be moved, together.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/common.sh

case ${1:-} in
  -h | --help)
    sed -n '2,4s/^# //p' scripts/install.sh
    exit
    ;;
  -* | '') prefix=$HOME/.local ;;
  *)
    prefix=$1
    shift
    ;;
esac
[ "$(uname -s)" = Linux ] || fail "$(uname -s): only Linux is supported"
need cargo python3 cc
mkdir -p "$prefix/bin" "$prefix/lib" || fail "$prefix: cannot be written; name another folder: scripts/install.sh PREFIX"
[ -w "$prefix/bin" ] && [ -w "$prefix/lib" ] || fail "$prefix: cannot be written; name another folder: scripts/install.sh PREFIX"
prefix=$(cd "$prefix" && pwd)

cargo build --release --locked -p tce "$@"
program=$(metadata "m['target_directory']")/release/tce
install_file 644 "$(library_of "$(uname -m)")" "$prefix/lib/$LIBRARY"
install_file 755 "$program" "$prefix/bin/tce"
try_out "$prefix/bin/tce"
helps "$prefix/bin/tce" "$prefix"

echo "$prefix/bin/tce, $prefix/lib/$LIBRARY"
case :$PATH: in
  *":$prefix/bin:"*) ;;
  *) echo "To call it by its name: export PATH=\"$prefix/bin:\$PATH\"" ;;
esac
