#!/bin/sh
# What happens: under -std=c99 Clang (here as zig cc) contracts a * b + c into one fused operation wherever the target has
# one, so on every ARM of 64 bits; GCC does so under -std=gnu99 only, and stops under -std=c99.
# Why most guess wrong: the strict standard is taken for the flag that makes results the same everywhere, and with GCC it is.
# Who meets it: generated C that is checked against an interpreter to the last bit on one machine and deployed on another:
# the cross compiler of a board is Clang as often as GCC. -ffp-contract=off says it to both.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check ziglang==0.17.1
cd "$folder"
echo 'double f(double a, double b, double c) { return a * b + c; }' > f.c
zig="$folder/venv/bin/python -m ziglang cc"
export ZIG_GLOBAL_CACHE_DIR="$folder/cache" ZIG_LOCAL_CACHE_DIR="$folder/cache"
$zig --version | head -1
fused() { grep -ciE 'fmadd|vfma' f.s || true; }
for target in aarch64-linux-gnu x86_64-linux-gnu; do
  case $target in x86_64*) cpu=-mcpu=haswell ;; *) cpu= ;; esac
  for flags in -std=gnu99 -std=c99 "-std=c99 -ffp-contract=off"; do
    $zig -target $target $cpu -O2 $flags -S -o f.s f.c 2>/dev/null
    count=$(fused)
    echo "clang $target $flags: $count fused"
    case $flags in *off) test "$count" = 0 ;; *) test "$count" != 0 ;; esac || { echo "the behaviour has changed"; exit 1; }
  done
done
if command -v gcc >/dev/null && gcc -dumpmachine | grep -q x86_64; then
  gcc --version | head -1
  for flags in -std=gnu99 -std=c99; do
    gcc -mfma -O2 $flags -S -o f.s f.c
    count=$(fused)
    echo "gcc x86_64 $flags: $count fused"
    case $flags in -std=c99) test "$count" = 0 ;; *) test "$count" != 0 ;; esac || { echo "the behaviour has changed"; exit 1; }
  done
fi
