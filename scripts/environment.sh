# Sourced by the other shell scripts: makes .venv if it is missing and brings what is asked for into it.
# usage: prepare EXTRAS   (for example "" or "[dev]")
prepare() {
    if [ ! -x .venv/bin/python ]; then
        echo "making .venv with $(python3 --version)"
        python3 -m venv .venv
    fi
    local wanted="$1 $(cksum < pyproject.toml)"
    if [ "$(cat .venv/installed 2>/dev/null)" != "$wanted" ]; then
        echo "installing pancam_graph$1 and what it needs into .venv (a minute or two, once)"
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --editable ".$1"
        echo "$wanted" > .venv/installed
    fi
}
