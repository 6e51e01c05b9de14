#!/usr/bin/env bash
# Make .venv with ortho-pipeline, its tools, and GDAL bindings that match a GDAL library. Called by `make setup`.
#
# The bindings are the only hard part: the package "gdal" of PyPI is source that has to be compiled against a GDAL
# library of exactly its own version. So: take the system's library (apt installs it where we may), build the
# bindings of its version; or, where neither is possible, take gdal-wheel, which carries a library inside.
# All other packages have the versions and hashes of tools/constraints.txt.
set -euo pipefail

PYTHON="${PYTHON:-python3}"
GDAL="${GDAL:-auto}"
APT="${APT:-auto}"
VENV="${VENV:-.venv}"
CONSTRAINTS="${CONSTRAINTS:-tools/constraints.txt}"

say() { printf '[setup] %s\n' "$*"; }
fail() {
    printf '\n[setup] FAILED: %s\n' "$1" >&2
    shift
    printf '[setup] Remedy: %s\n' "$@" >&2
    exit 1
}
have() { command -v "$1" >/dev/null 2>&1; }

# Packages of the system that are missing, and what each is for.
declare -A reasons=()
missing=() optional=()
want() { missing+=("$1") reasons[$1]="$2"; }

have_apt() { have apt-get && { [ "$(id -u)" = 0 ] || { have sudo && sudo -n true 2>/dev/null; }; }; }
may_install() { [ "$APT" = auto ] && have_apt; }
apt_command() { printf '%sapt-get install %s' "$([ "$(id -u)" = 0 ] || echo 'sudo ')" "$*"; }

# What is missing, before anything is changed.
look_around() {
    have "$PYTHON" || [ "$PYTHON" != python3 ] || want python3 "the interpreter"
    if ! have "$PYTHON" || ! "$PYTHON" -c "import ensurepip, venv" 2>/dev/null; then want python3-venv "makes $VENV"; fi
    if [ "$GDAL" != wheel ]; then
        have gdal-config || want libgdal-dev "GDAL's library and headers, for which the bindings are built"
        have gdalinfo || want gdal-bin "GDAL's programs, with which tests compare"
        have g++ || want g++ "compiles the bindings of GDAL"
        has_headers || want python3-dev "Python's headers, for the bindings of GDAL"
        have_grid || want proj-data "the geoid grid of EGM96"
    fi
    have chromium || have chromium-browser || have google-chrome || optional=(chromium)
    reasons[chromium]="a browser, for tests of the pages; they are skipped without one"
}

# Say which packages are missing and what is done about it, then do that.
install_missing() {
    local all=("${missing[@]}" "${optional[@]}") package
    [ ${#all[@]} -gt 0 ] || return 0
    say "Packages of the system that are missing:"
    for package in "${all[@]}"; do say "  $package: ${reasons[$package]}"; done
    if ! may_install; then
        if [ "$APT" = no ]; then say "APT=no: not installing them."; else say "No right to install them, or no apt."; fi
        say "To install them: $(apt_command "${all[@]}")"
        return
    fi
    say "Installing them now with apt-get as root (APT=no forbids this)."
    as_root apt-get update -qq || fail "apt-get update failed" "check the network and /etc/apt/sources.list"
    if [ ${#missing[@]} -gt 0 ]; then
        apt_install "${missing[@]}" || fail "apt-get could not install: ${missing[*]}" \
            "run: $(apt_command "${missing[@]}")" "then run make again"
    fi
    if [ ${#optional[@]} -gt 0 ]; then
        apt_install "${optional[@]}" || say "NOTE: apt-get could not install: ${optional[*]}"
    fi
}

as_root() { if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi; }
apt_install() {
    say "apt-get install $*"
    as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" >/dev/null
}

python_is() { "$PYTHON" -c "import sys; sys.exit(sys.version_info < ($1))" 2>/dev/null; }
has_headers() { "$PYTHON" -c "import os, sysconfig as s; h = s.get_path('include'); assert os.path.exists(h + '/Python.h')" 2>/dev/null; }

need_python() {
    have "$PYTHON" || fail "no interpreter named '$PYTHON'" "install Python 3.11 or newer, or run: make PYTHON=/path/of/python3"
    python_is "3, 11" || fail "$("$PYTHON" --version) is too old: 3.11 or newer is needed" \
        "run: make PYTHON=python3.12 (or another interpreter that you have)"
    "$PYTHON" -c "import ensurepip, venv" 2>/dev/null ||
        fail "the module venv or ensurepip of $PYTHON is missing" "run: $(apt_command python3-venv)"
}

# Decide between the system's GDAL and the wheel. Sets $way.
choose_gdal() {
    way=wheel
    [ "$GDAL" != wheel ] || return 0
    if have gdal-config && have g++ && has_headers; then
        way=system
    elif [ "$GDAL" = system ] || ! python_is "3, 12"; then
        fail "the system's GDAL cannot be used: missing ${missing[*]}" "run: $(apt_command "${missing[@]}")" \
            "or, with Python 3.12 or newer: make GDAL=wheel PYTHON=python3.12"
    else
        say "The system's GDAL cannot be used (missing ${missing[*]}): taking gdal-wheel."
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
    # The pip that comes with Python may be too old to take hashes from constraints.
    sed -n '/^pip==/,/# via/p' "$CONSTRAINTS" >"$VENV/pip.txt"
    pip install --require-hashes -r "$VENV/pip.txt"
    pinned hatchling numpy setuptools wheel
}

pip() {
    "$VENV/bin/python" -m pip --disable-pip-version-check "$@" --quiet ||
        fail "pip $*" "read the message of pip above; check the network and the proxy"
}

# Install packages and what they require, all of them with the versions and hashes that are pinned.
pinned() { pip install --require-hashes -c "$CONSTRAINTS" "$@"; }

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
        CFLAGS="$headers ${CFLAGS:-}" CXXFLAGS="$headers ${CXXFLAGS:-}" pip install --no-deps --no-build-isolation --no-cache-dir "gdal[numpy]==$library"
        [ "$(bindings_version)" = "$library" ] || fail "the bindings of GDAL $library do not load" \
            "$VENV/bin/python -c 'from osgeo import gdal_array' shows why" "or run: make GDAL=wheel PYTHON=python3.12"
    else
        python_is "3, 12" || fail "gdal-wheel needs Python 3.12 or newer, this is $("$PYTHON" --version)" \
            "run: make GDAL=wheel PYTHON=python3.12" "or, with root: apt install libgdal-dev g++ python3-dev proj-data"
        say "installing gdal-wheel (brings its own GDAL)"
        "$VENV/bin/python" -m pip uninstall --quiet --yes gdal 2>/dev/null || true
        pinned gdal-wheel
        [ -n "$(bindings_version)" ] || fail "gdal-wheel does not load" \
            "$VENV/bin/python -c 'from osgeo import gdal_array' shows why"
    fi
}

case "$GDAL" in auto | system | wheel) ;; *) fail "GDAL=$GDAL is not known" "GDAL=auto, GDAL=system or GDAL=wheel" ;; esac
case "$APT" in auto | no) ;; *) fail "APT=$APT is not known" "APT=auto or APT=no" ;; esac
look_around
install_missing
need_python
choose_gdal
make_venv
install_bindings
say "installing ortho-pipeline and its tools (editable)"
"$VENV/bin/python" tools/requirements.py dev >"$VENV/requirements.txt"
pinned -r "$VENV/requirements.txt"
pip install --no-deps --no-build-isolation --no-index --editable .
have_grid || say "NOTE: no EGM96 grid found. Heights above EGM96 will be refused. Remedy: $(apt_command proj-data), or set PROJ_DATA."
say "done: $VENV/bin/ortho, GDAL $(bindings_version) ($way)"
