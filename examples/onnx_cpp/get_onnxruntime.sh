#!/usr/bin/env bash
# Lay out FOLDER like an unpacked release of ONNX Runtime, out of packages: for machines that reach
# Debian's archive and PyPI only. The library is that of the Python package onnxruntime, which PYTHON
# has; the headers, which it lacks, are of Debian's libonnxruntime-dev. They are of an older version,
# which a newer library serves.
#
#     get_onnxruntime.sh FOLDER PYTHON
set -euo pipefail

end() {
    echo "get_onnxruntime.sh: $1" >&2
    exit 2
}
test $# -eq 2 || end "give a folder, and the Python that has onnxruntime"
for program in apt-get dpkg-deb "$2"; do
    command -v "$program" > /dev/null || end "there is no $program: unpack a release instead"
done
folder=$(realpath -m "$1")
python=$2
package=$("$python" -c 'import importlib.util as u
print(*(spec.submodule_search_locations if (spec := u.find_spec("onnxruntime")) else ()))')
test -n "$package" || end "$python has no package onnxruntime: $python -m pip install onnxruntime"
library=$(find "$package/capi" -name 'libonnxruntime.so.*' | head -1)
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

ln -sf "$library" "$folder/lib/libonnxruntime.so"
ln -sf "$library" "$folder/lib/libonnxruntime.so.1"
