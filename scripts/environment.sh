# Functions that the other shell scripts share. They are sourced, with the repository as working directory.
#
#   prepare EXTRAS            brings the package with EXTRAS ("" or "[dev]") into .venv
#   promised_versions         prints the versions of Python that pyproject.toml promises, newest first
#   interpreter_of VERSION    prints the path of a usable interpreter of that version, or nothing
#   make_environment, install_into: the two steps of `prepare`, for environments elsewhere

# The versions that development and CI use. To renew them: the command at the top of the file, with --upgrade.
LOCK=.ci/requirements.lock

promised_versions() {
    sed -n 's/.*"Programming Language :: Python :: \(3\.[0-9]*\)".*/\1/p' pyproject.toml | sort -t . -k 2 -n -r
}

# The promised versions as text: "3.11 to 3.14".
promised_range() {
    echo "$(promised_versions | tail -n 1) to $(promised_versions | head -n 1)"
}

# Prints the version of an interpreter ("3.12"), or why no environment can be made with it ("is Python 3.10").
examine() {
    "$1" -c '
import sys, sysconfig
version = "%d.%d" % sys.version_info[:2]
if version not in sys.argv[1:]:
    print("is Python " + version)
elif sys.implementation.name != "cpython":
    print("is " + sys.implementation.name + ", not CPython")
elif sysconfig.get_config_var("Py_GIL_DISABLED"):
    print("is a free-threaded build of Python " + version)
else:
    try:
        import ensurepip, venv
        print(version)
    except ImportError:
        print("is Python " + version + " without the venv module (Debian and Ubuntu have it in python" + version + "-venv)")
' $(promised_versions) 2>/dev/null || echo "does not start"
}

# Looks on the PATH, then among the interpreters that pyenv and uv keep.
interpreter_of() {
    local pyenv="${PYENV_ROOT:-${HOME:-}/.pyenv}/versions"
    local uv="${UV_PYTHON_INSTALL_DIR:-${XDG_DATA_HOME:-${HOME:-}/.local/share}/uv/python}"
    local path
    while IFS= read -r path; do
        if [ -x "$path" ] && [ "$(examine "$path")" = "$1" ]; then
            echo "$path"
            return 0
        fi
    done < <(type -a -p "python$1"; printf '%s\n' "$pyenv"/*/bin/"python$1" "$uv"/*/bin/"python$1")
}

# Sets `python` to an interpreter of a promised version: python3 if it is one, otherwise the newest of the others.
find_python() {
    local answer version
    if command -v python3 >/dev/null; then answer=$(examine python3); else answer="is not on the PATH"; fi
    python=python3
    case "$answer" in [0-9]*) return 0 ;; esac
    for version in $(promised_versions); do
        python=$(interpreter_of "$version")
        if [ -n "$python" ]; then
            echo "python3 $answer; pancam_graph needs Python $(promised_range), so $python is used"
            return 0
        fi
    done
    echo "pancam_graph needs Python $(promised_range) with the venv module, but python3 $answer and no other that would do was found:" \
        "install one, for example from your system's packages, python.org, pyenv or uv" >&2
    return 2
}

# usage: make_environment FOLDER INTERPRETER   (what FOLDER held before is removed)
make_environment() {
    echo "making $1 with $("$2" --version)"
    "$2" -m venv --clear "$1" || { echo "could not make $1 with $2: see the message above" >&2; return 2; }
}

# usage: install_into FOLDER EXTRAS [OPTIONS OF pip install]
install_into() {
    local folder=$1 extras=$2
    shift 2
    if ! "$folder/bin/python" -m pip --version >/dev/null 2>&1; then
        "$folder/bin/python" -m ensurepip >/dev/null 2>&1 ||
            { echo "$folder has no pip: remove $folder and start again" >&2; return 2; }
    fi
    "$folder/bin/python" -m pip install --quiet --disable-pip-version-check --editable ".$extras" "$@" ||
        { echo "could not install pancam_graph$extras into $folder: see pip's message above" >&2; return 2; }
}

prepare() {
    local version="" wanted have python
    if [ -e .venv ] || [ -L .venv ]; then
        version=$(.venv/bin/python -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || version=""
        if [ -z "$version" ]; then
            echo ".venv is broken: its interpreter does not start"
        elif ! promised_versions | grep -q -x -F "$version"; then
            echo ".venv is of Python $version, and pancam_graph needs $(promised_range)"
            version=""
        fi
    fi
    if [ -z "$version" ]; then
        find_python
        make_environment .venv "$python"
    fi
    # A repository that was moved, or a .venv whose interpreter was upgraded, needs the installation again.
    wanted=$({ cat pyproject.toml "$LOCK"; pwd; .venv/bin/python --version; } | cksum)
    for have in "$1" "[dev]"; do
        if [ "$(cat ".venv/installed$have" 2>/dev/null)" = "$wanted" ]; then return 0; fi
    done
    echo "installing pancam_graph$1 and what it needs into .venv (a minute or two, once)"
    if [ "$1" = "[dev]" ]; then
        install_into .venv "$1" --constraint "$LOCK"
    else
        install_into .venv "$1"
    fi
    echo "$wanted" > ".venv/installed$1"
}
