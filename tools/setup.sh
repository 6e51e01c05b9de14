#!/usr/bin/env bash
# Make .venv with ortho-pipeline, its tools, and GDAL bindings that match a GDAL library. Called by `make setup`.
#
# The bindings are the only hard part: the package "gdal" of PyPI is source that has to be compiled against a GDAL
# library of exactly its own version. So: take the system's library (apt installs it where we may), build the
# bindings of its version; or, where neither is possible, take gdal-wheel, which carries a library inside.
set -euo pipefail

PYTHON="${PYTHON:-python3}"
GDAL="${GDAL:-auto}"
VENV="${VENV:-.venv}"

say() { printf '[setup] %s\n' "$*"; }
fail() {
    printf '\n[setup] FAILED: %s\n' "$1" >&2
    shift
    printf '[setup] Remedy: %s\n' "$@" >&2
    exit 1
}
have() { command -v "$1" >/dev/null 2>&1; }

may_install() { have apt-get && { [ "$(id -u)" = 0 ] || { have sudo && sudo -n true 2>/dev/null; }; }; }
apt_updated=no
apt_install() {
    local root=()
    [ "$(id -u)" = 0 ] || root=(sudo -n)
    say "apt-get install $*"
    if [ "$apt_updated" = no ]; then
        "${root[@]}" apt-get update -qq || fail "apt-get update failed" "check the network and /etc/apt/sources.list"
        apt_updated=yes
    fi
    "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null ||
        fail "apt-get could not install: $*" "install these packages by hand, then run make again"
}

python_is() { "$PYTHON" -c "import sys; sys.exit(sys.version_info < ($1))" 2>/dev/null; }
has_headers() { "$PYTHON" -c "import os, sysconfig as s; h = s.get_path('include'); assert os.path.exists(h + '/Python.h')" 2>/dev/null; }

need_python() {
    if ! have "$PYTHON" && [ "$PYTHON" = python3 ] && may_install; then apt_install python3; fi
    have "$PYTHON" || fail "no interpreter named '$PYTHON'" "install Python 3.11 or newer, or run: make PYTHON=/path/of/python3"
    python_is "3, 11" || fail "$("$PYTHON" --version) is too old: 3.11 or newer is needed" \
        "run: make PYTHON=python3.12 (or another interpreter that you have)"
    if ! "$PYTHON" -c "import ensurepip, venv" 2>/dev/null; then
        may_install || fail "the module venv or ensurepip of $PYTHON is missing" "apt install python3-venv"
        apt_install python3-venv
    fi
}

# Decide between the system's GDAL and the wheel, and install what the system's way needs. Sets $way.
choose_gdal() {
    way="$GDAL"
    case "$GDAL" in
    auto | system) ;;
    wheel) return ;;
    *) fail "GDAL=$GDAL is not known" "GDAL=auto, GDAL=system or GDAL=wheel" ;;
    esac
    local missing=()
    have gdal-config || missing+=(libgdal-dev)
    have gdalinfo || missing+=(gdal-bin)
    have g++ || missing+=(g++)
    has_headers || missing+=(python3-dev)
    have_grid || missing+=(proj-data)
    if [ ${#missing[@]} -gt 0 ] && may_install; then apt_install "${missing[@]}"; fi
    if have gdal-config && have g++ && has_headers; then
        way=system
    elif [ "$GDAL" = system ]; then
        fail "the system's GDAL cannot be used: missing ${missing[*]}, and no right to install it" \
            "ask for: apt install ${missing[*]}" "or run: make GDAL=wheel PYTHON=python3.12"
    else
        say "no usable system GDAL (missing ${missing[*]}) and no right to install it: taking gdal-wheel"
        way=wheel
    fi
}

# The EGM96 grid of proj-data: without it heights above EGM96 are refused.
have_grid() {
    local folder
    for folder in "${PROJ_DATA:-}" "${PROJ_LIB:-}" /usr/share/proj /usr/local/share/proj "$HOME/.local/share/proj"; do
        [ -n "$folder" ] || continue
        if [ -e "$folder/egm96_15.gtx" ] || [ -e "$folder/us_nga_egm96_15.tif" ]; then return 0; fi
    done
    return 1
}

make_venv() {
    if [ -x "$VENV/bin/python" ] && [ "$("$VENV/bin/python" -c 'import sys; print(sys.version)' 2>/dev/null)" = \
        "$("$PYTHON" -c 'import sys; print(sys.version)')" ]; then
        say "$VENV is there ($("$VENV/bin/python" --version))"
    else
        say "making $VENV with $("$PYTHON" --version)"
        "$PYTHON" -m venv --clear "$VENV" || fail "could not make $VENV" "apt install python3-venv, or another PYTHON="
    fi
    pip install --upgrade pip setuptools wheel numpy
}

pip() {
    "$VENV/bin/python" -m pip --disable-pip-version-check "$@" --quiet ||
        fail "pip $*" "read the message of pip above; check the network and the proxy"
}

bindings_version() {
    "$VENV/bin/python" -c "from osgeo import gdal, gdal_array; print(gdal.__version__)" 2>/dev/null || true
}

install_bindings() {
    local library
    if [ "$way" = system ]; then
        library="$(gdal-config --version)"
        if [ "$(bindings_version)" = "$library" ]; then
            say "GDAL bindings $library are there"
            return
        fi
        say "building the GDAL bindings $library for the system's library (about a minute)"
        "$VENV/bin/python" -m pip uninstall --quiet --yes gdal gdal-wheel 2>/dev/null || true
        # Without isolation the build sees the numpy of the venv; from a cache it might come without numpy's support.
        # Debian's python3-numpy (which gdal-bin brings) lies in Python's own include folder and would be found first;
        # bindings made with its headers do not load with the numpy of the venv.
        local headers
        headers="-I$("$VENV/bin/python" -c 'import numpy; print(numpy.get_include())')"
        CFLAGS="$headers ${CFLAGS:-}" CXXFLAGS="$headers ${CXXFLAGS:-}" pip install --no-build-isolation --no-cache-dir "gdal[numpy]==$library"
        [ "$(bindings_version)" = "$library" ] || fail "the bindings of GDAL $library do not load" \
            "$VENV/bin/python -c 'from osgeo import gdal_array' shows why" "or run: make GDAL=wheel PYTHON=python3.12"
    else
        python_is "3, 12" || fail "gdal-wheel needs Python 3.12 or newer, this is $("$PYTHON" --version)" \
            "run: make GDAL=wheel PYTHON=python3.12" "or, with root: apt install libgdal-dev g++ python3-dev proj-data"
        say "installing gdal-wheel (brings its own GDAL)"
        "$VENV/bin/python" -m pip uninstall --quiet --yes gdal 2>/dev/null || true
        pip install gdal-wheel
        [ -n "$(bindings_version)" ] || fail "gdal-wheel does not load" \
            "$VENV/bin/python -c 'from osgeo import gdal_array' shows why"
    fi
}

# A browser for the tests that look at the report; without it they are skipped.
want_browser() {
    if have chromium || have chromium-browser || have google-chrome; then return; fi
    if may_install; then
        (apt_install chromium) || say "NOTE: no Chromium: the tests of the report in a browser will be skipped."
    else
        say "NOTE: no Chromium and no right to install it: the tests of the report in a browser will be skipped."
    fi
}

need_python
choose_gdal
want_browser
make_venv
install_bindings
say "installing ortho-pipeline and its tools (editable)"
pip install --editable ".[dev]"
have_grid || say "NOTE: no EGM96 grid found. Heights above EGM96 will be refused. Remedy: apt install proj-data, or set PROJ_DATA."
say "done: $VENV/bin/ortho, GDAL $(bindings_version) ($way)"
