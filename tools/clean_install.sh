#!/usr/bin/env bash
# Build sdist and wheel, install both in an environment that knows nothing of the repository, and do the sample job
# there: `make packages`. Says at the end what was tried; anything that does not hold ends it.
#
#   tools/clean_install.sh python3.11=system python3.13=wheel
#
# system: bindings built for the library of gdal-config.  wheel: the extra `wheel` (Python 3.12 or newer).
set -euo pipefail

ROOT="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
[ $# -gt 0 ] || { sed -n '2,/^set/s/^# \{0,1\}//p' "$0" >&2; exit 2; }
unset PYTHONPATH PYTHONHOME VIRTUAL_ENV # nothing of the repository is on a path of what runs
PLACE="$(mktemp -d)"
trap 'rm -rf "$PLACE"' EXIT

missing=() # found before minutes of work
for one in "$@"; do
    python="${one%%=*}" way="${one##*=}"
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        missing+=("$one: $python cannot be run, or has no module venv. A path works too: /path/to/python=$way")
    elif [ "$way" = system ]; then
        command -v gdal-config >/dev/null || missing+=("$one: gdal-config of the system's GDAL (libgdal-dev)")
    elif [ "$way" != wheel ]; then
        missing+=("$one: write $python=system or $python=wheel")
    elif ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 12))'; then
        missing+=("$one: the wheel needs Python 3.12 or newer")
    fi
done
if [ ${#missing[@]} -gt 0 ]; then
    printf '[packages] MISSING: %s\n' "${missing[@]}" >&2
    exit 1
fi

say() { printf '[packages] %s\n' "$*"; }
quietly() { "$@" >"$PLACE/log" 2>&1 || { tail -40 "$PLACE/log" >&2; say "FAILED: $*" >&2; exit 1; }; }

build() { # with the first interpreter: an sdist, and a wheel from what the sdist has
    quietly "$1" -m venv "$PLACE/build"
    quietly "$PLACE/build/bin/python" -m pip install build hatchling
    quietly "$PLACE/build/bin/python" -m build --no-isolation --outdir "$PLACE/dist" "$ROOT"
    say "built: $(cd "$PLACE/dist" && ls -sh | tail -n +2 | awk '{print $2 " (" $1 ")"}' | paste -sd ' ')"
}

install() { # $1 environment, $2 system or wheel, $3 the file: what docs/install.md says
    local pip=("$1/bin/python" -m pip --disable-pip-version-check)
    if [ "$2" = wheel ]; then
        quietly "${pip[@]}" install "$3[wheel]"
        return
    fi
    quietly "${pip[@]}" install "$3"
    "$1/bin/python" -c 'from osgeo import gdal_array' 2>/dev/null && return
    quietly "${pip[@]}" install setuptools wheel
    local headers
    headers="-I$("$1/bin/python" -c 'import numpy; print(numpy.get_include())')"
    CFLAGS="$headers" CXXFLAGS="$headers" quietly "${pip[@]}" install --no-build-isolation --no-cache-dir \
        "gdal[numpy]==$(gdal-config --version)"
}

try() { # $1 environment: doctor, plugins and the sample job, in an empty folder
    local work="$PLACE/work"
    rm -rf "$work" && mkdir "$work" && cp -r "$ROOT/sample_data" "$work/sample_data"
    (cd "$work" && "$1/bin/python" "$PLACE/tried.py" "$1/bin/ortho" "$(ls "$ROOT/plugins" | grep '^ortho_')")
}

cat >"$PLACE/tried.py" <<'PYTHON'
import json, pathlib, subprocess, sys

ortho, plugins = sys.argv[1], sys.argv[2].split()


def run(*words):
    done = subprocess.run([ortho, *words], capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(words)}: exit {done.returncode}\n{done.stdout}{done.stderr}")
    return done


import ortho_pipeline

prefix = pathlib.Path(sys.prefix).resolve()
assert pathlib.Path(ortho_pipeline.__file__).resolve().is_relative_to(prefix), ortho_pipeline.__file__
assert (pathlib.Path(ortho_pipeline.__file__).parent / "py.typed").exists()
doctor = json.loads(run("doctor", "--json").stdout)
assert not doctor["broken"], doctor["broken"]
found = {one["module"] for one in doctor["plugins"] if one["distribution"] == "ortho-pipeline"}
assert found >= set(plugins), set(plugins) - found
assert not json.loads(run("sensors", "--json").stdout)["broken"]
made = json.loads(run("rectify", "sample_data/scene.tif", "--gcps", "sample_data/gcps.geojson",
                      "--dem", "sample_data/dem.tif", "-o", "out", "--json").stdout)
rmse = made["report"]["adjustment"]["rmse"]["check"]["total"]
assert abs(rmse - 0.19) < 0.01, rmse
assert pathlib.Path("out/scene_report.html").stat().st_size > 100_000
run("simulate", "bilsat", "--seed", "1", "-o", "simulated")  # a plugin's command
print(f"[packages]   doctor clean, {len(found)} plugins, the sample's check points {rmse:.2f} px, GDAL {doctor['gdal']['version']}")
PYTHON

build "${1%%=*}"
for one in "$@"; do
    python="${one%%=*}" way="${one##*=}" home="$PLACE/home"
    for file in "$PLACE"/dist/*.whl "$PLACE"/dist/*.tar.gz; do
        if [ "${file##*.}" = whl ]; then
            rm -rf "$home" && quietly "$python" -m venv "$home"
        else # the same requirements stay; the package itself goes
            quietly "$home/bin/python" -m pip uninstall --yes ortho-pipeline
        fi
        say "$("$python" --version), GDAL $way, $(basename "$file")"
        install "$home" "$way" "$file"
        try "$home"
    done
done
