# What the scripts share; to be sourced. shellcheck shell=bash

readonly MUJOCO=3.17.0
readonly LIBRARY=libmujoco.so.$MUJOCO

fail() {
  echo "${0##*/}: $*" >&2
  exit 1
}

# The programs that are named must be there.
need() {
  local program
  for program in "$@"; do
    command -v "$program" > /dev/null || fail "$program: not found on the path; install it first"
  done
}

# A value out of `cargo metadata`, by a Python expression over `m`.
metadata() {
  cargo metadata --locked --no-deps --format-version 1 | python3 -c "import json, sys; m = json.load(sys.stdin); print($1)"
}

version() {
  metadata "next(p['version'] for p in m['packages'] if p['name'] == 'tce')"
}

# Where the library lies that the build for this architecture fetched, or that TCE_MUJOCO_LIB names.
library_of() {
  local library=${TCE_MUJOCO_LIB:-third_party/mujoco/$MUJOCO-linux-$1/$LIBRARY}
  [ -f "$library" ] || fail "$library: no such file, although the build is done; is TCE_MUJOCO_LIB right?"
  echo "$library"
}

# Gives a file its place in one step: install_file MODE FROM TO
install_file() {
  mkdir -p "$(dirname "$3")"
  local half
  half=$(mktemp "$(dirname "$3")/.${3##*/}.XXXXXX")
  if ! { cp "$2" "$half" && chmod "$1" "$half" && mv -f "$half" "$3"; }; then
    rm -f "$half"
    fail "$3: cannot be written"
  fi
}

# Manual pages and completions, made by a program that runs here: helps PROGRAM PREFIX
helps() {
  "$1" man --out "$2/share/man/man1" > /dev/null || fail "$2/share/man: cannot be written"
  local shell place half
  for shell in bash zsh fish; do
    case $shell in
      bash) place=$2/share/bash-completion/completions/tce ;;
      zsh) place=$2/share/zsh/site-functions/_tce ;;
      fish) place=$2/share/fish/vendor_completions.d/tce.fish ;;
    esac
    half=$(mktemp)
    "$1" completions "$shell" > "$half" || fail "$1 completions $shell: failed"
    install_file 644 "$half" "$place"
    rm -f "$half"
  done
}

# One episode in the simulator, by a program that must find its library by itself.
try_out() {
  env -u TCE_MUJOCO_LIB -u LD_LIBRARY_PATH "$1" evaluate zoo:hopper-source-medium --env hopper --episodes 1 > /dev/null ||
    fail "$1: cannot simulate where it was put"
}
