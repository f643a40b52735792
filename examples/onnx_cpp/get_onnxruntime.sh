#!/usr/bin/env bash
# Lay out FOLDER like an unpacked release of ONNX Runtime, out of packages: for machines that reach
# Debian's archive and PyPI only. The library is that of the Python package onnxruntime, which PYTHON
# has; the headers, which it lacks, are of Debian's libonnxruntime-dev. They are of an older version,
# which a newer library serves.
#
#     get_onnxruntime.sh FOLDER PYTHON
set -euo pipefail
folder=$(realpath -m "$1")
python=$2
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

mkdir -p "$work"/{lists,cache/archives}/partial "$work/parts" "$folder/lib"
keys=/usr/share/keyrings/debian-archive-keyring.gpg
echo "deb [signed-by=$keys] http://deb.debian.org/debian trixie main" > "$work/sources.list"
apt=(apt-get -qq -o "Dir::Etc::SourceList=$work/sources.list" -o Dir::Etc::SourceParts=/dev/null
    -o "Dir::State::Lists=$work/lists" -o "Dir::Cache=$work/cache" -o APT::Sandbox::User=root)
"${apt[@]}" update
(cd "$work" && "${apt[@]}" download libonnxruntime-dev)
dpkg-deb -x "$work"/libonnxruntime-dev_*.deb "$work/parts"
rm -rf "$folder/include"
mv "$work/parts/usr/include/onnxruntime" "$folder/include"

capi=$("$python" -c 'import importlib.util as u; print(u.find_spec("onnxruntime").submodule_search_locations[0])')/capi
library=$(find "$capi" -name 'libonnxruntime.so.*' | head -1)
ln -sf "$library" "$folder/lib/libonnxruntime.so"
ln -sf "$library" "$folder/lib/libonnxruntime.so.1"
