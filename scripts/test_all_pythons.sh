#!/usr/bin/env bash
# The fast tests under every promised version of Python that is found, with the newest releases of what the package needs;
# "3.11-lowest" is version 3.11 with the lowest releases that pyproject.toml allows. Each has an environment of its own
# in .venvs, and a line in the table at the end. Arguments go to pytest (for example: -m slow, tests/factors).
#
#   PYTHONS="3.12 3.11-lowest" bash scripts/test_all_pythons.sh    only these
set -euo pipefail
cd "$(dirname "$0")/.."
. scripts/environment.sh
if [ $# -eq 0 ]; then set -- -m "not slow"; fi

# usage: install_newest FOLDER
install_newest() {
    install_into "$1" "[test,terrain,cluster]" --upgrade --upgrade-strategy eager
}

# usage: install_lowest FOLDER
install_lowest() {
    "$1/bin/python" -c '
import re, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
extras = project["optional-dependencies"]
for requirement in project["dependencies"] + extras["test"] + extras["terrain"] + extras["cluster"]:
    print(re.sub(r"\[.*?\]", "", requirement).replace(">=", "=="))
' > "$1/lowest.txt" && install_into "$1" "[test,terrain,cluster]" --constraint "$1/lowest.txt"
}

table=""
failed=0
for name in ${PYTHONS:-$(promised_versions) "$(promised_versions | tail -n 1)-lowest"}; do
    python=$(interpreter_of "${name%-lowest}")
    folder=.venvs/$name
    if [ -z "$python" ]; then
        result="no interpreter found"
    else
        echo "== $name: $python"
        if [ ! -x "$folder/bin/python" ]; then make_environment "$folder" "$python"; fi
        case "$name" in *-lowest) install=install_lowest ;; *) install=install_newest ;; esac
        log=$folder/tests.log
        if ! $install "$folder"; then
            result="could not be installed"
            failed=1
        else
            OPENBLAS_NUM_THREADS=1 "$folder/bin/python" -m pytest -q -n "${PYTEST_WORKERS:-2}" --dist worksteal "$@" 2>&1 | tee "$log" || failed=1
            result=$(tail -n 1 "$log")
        fi
    fi
    table="$table$(printf '%-13s %s' "$name" "$result")"$'\n'
done
printf '\n%s' "$table"
exit $failed
