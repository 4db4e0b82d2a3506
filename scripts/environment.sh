# Sourced by the other shell scripts: makes .venv if it is missing and brings what is asked for into it.
# usage: prepare EXTRAS   (for example "" or "[dev]", which has all that "" has)
prepare() {
    if [ ! -x .venv/bin/python ]; then
        echo "making .venv with $(python3 --version)"
        python3 -m venv .venv
    fi
    local wanted have
    wanted=$(cksum < pyproject.toml)
    for have in "$1" "[dev]"; do
        if [ "$(cat ".venv/installed$have" 2>/dev/null)" = "$wanted" ]; then return 0; fi
    done
    echo "installing pancam_graph$1 and what it needs into .venv (a minute or two, once)"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".$1"
    echo "$wanted" > ".venv/installed$1"
}
