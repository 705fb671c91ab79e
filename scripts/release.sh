#!/usr/bin/env bash
# Makes dist/tce-VERSION-linux-ARCH.tar.gz, with its SHA-256 beside it, and the wheel of the Python package: scripts/release.sh [x86_64|aarch64]
# The default is this machine's architecture; the other one takes a target (rustup target add aarch64-unknown-linux-gnu) and a
# linker (CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc, and CC_aarch64_unknown_linux_gnu likewise).
# The program needs a glibc as new as this machine's allows it to: build on the oldest system that shall run it.
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/common.sh

case ${1:-} in
  -h | --help)
    sed -n '2,5s/^# //p' scripts/release.sh
    exit
    ;;
esac
here=$(uname -m)
arch=${1:-$here}
target=$arch-unknown-linux-gnu
case $arch in
  x86_64 | aarch64) ;;
  *) fail "$arch: expected x86_64 or aarch64" ;;
esac
[ "$(uname -s)" = Linux ] || fail "$(uname -s): a release is made on Linux"
need cargo rustc python3 cc git tar gzip sha256sum objdump strip
python3 -m pip --version > /dev/null 2>&1 || fail "python3 -m pip: does not work; MuJoCo's licences come out of its wheel"
if [ "$arch" != "$here" ]; then
  [ -d "$(rustc --print sysroot)/lib/rustlib/$target" ] || fail "$target: not installed; rustup target add $target"
  linker=CARGO_TARGET_$(echo "$target" | tr 'a-z-' 'A-Z_')_LINKER
  [ -n "${!linker:-}" ] || fail "$linker: not set, expected a linker for $target, such as $arch-linux-gnu-gcc"
  need "$arch-linux-gnu-strip"
fi
[ -z "$(git status --porcelain --untracked-files=no)" ] || echo "warning: there are changes that no commit has" >&2

build=$(metadata "m['target_directory']")/release
if [ "$arch" = "$here" ]; then
  cargo build --release --locked -p tce
else
  cargo build --release --locked -p tce --target "$target"
  build=${build%/release}/$target/release
fi
library=$(library_of "$arch")

mkdir -p dist
name=tce-$(version)-linux-$arch
work=$(mktemp -d "dist/.$name.XXXXXX")
trap 'rm -rf "$work"' EXIT
python3 -m pip --disable-pip-version-check download --quiet --no-deps --only-binary=:all: --python-version 3.12 \
  --platform "manylinux_2_28_$arch" --dest "$work" "mujoco==$MUJOCO"
python3 -m zipfile -e "$work"/mujoco-*.whl "$work/wheel"
cmp "$library" "$work/wheel/mujoco/$LIBRARY" || fail "$library: not the library of PyPI's wheel, whose licences the release shows"

doc=$work/$name/share/doc/tce
install_file 755 "$build/tce" "$work/$name/bin/tce"
install_file 644 "$library" "$work/$name/lib/$LIBRARY"
for file in README.md LICENSE-MIT LICENSE-APACHE; do
  install_file 644 "$file" "$doc/$file"
done
python3 scripts/third_party_licenses.py "$target" "$work/wheel" "$doc/THIRD_PARTY_LICENSES"
# The names of functions are a good part of the file.
strip=strip
[ "$arch" = "$here" ] || strip=$arch-linux-gnu-strip
"$strip" "$work/$name/bin/tce"
if [ "$arch" = "$here" ]; then
  try_out "$work/$name/bin/tce"
  helps "$work/$name/bin/tce" "$work/$name"
else
  echo "warning: manual pages and completions are left out: $arch programs do not run here" >&2
fi

tar --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$(git log -1 --format=%ct)" -C "$work" -cf - "$name" |
  gzip -9n > "$work/$name.tar.gz"
(cd "$work" && sha256sum "$name.tar.gz" > "$name.tar.gz.sha256")
glibc=$(objdump -T "$work/$name/bin/tce" | grep -o 'GLIBC_[0-9.]*' | sort -Vu | tail -n 1)
mv -f "$work/$name.tar.gz.sha256" "$work/$name.tar.gz" dist/
echo "dist/$name.tar.gz: $(du -h "dist/$name.tar.gz" | cut -f 1), needs ${glibc/_/ } or newer"

# The wheel of the Python package, for all versions from 3.10 on. It carries neither Rust nor MuJoCo.
if [ "$arch" = "$here" ]; then
  python3 -m pip --disable-pip-version-check install --quiet --upgrade --target "$work/maturin" 'maturin>=1.9.4,<2'
  PYTHONPATH="$work/maturin" python3 -m maturin build --release --locked --quiet --out dist
  ls dist/tce-*.whl
else
  echo "warning: the wheel is left out: maturin builds it on a machine of its architecture" >&2
fi
