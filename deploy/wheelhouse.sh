#!/usr/bin/env bash
# Everything that Abbe needs as one folder, for a computer without internet:
#   deploy/wheelhouse.sh abbe-wheels            # here, with internet; PYTHON=python3.11 deploy/wheelhouse.sh ... for another Python
#   abbe-wheels/install.sh /opt/abbe/.venv      # there, after the folder was carried over; same Python, same kind of system
# Every package is a wheel whose hash stands in the lock file; the list SHA256SUMS proves what arrives.
set -euo pipefail
[ $# -eq 1 ] || { echo "usage: deploy/wheelhouse.sh NEW-FOLDER" >&2; exit 2; }
[ ! -e "$1" ] || { echo "deploy/wheelhouse.sh: $1 exists; give the name of a new folder" >&2; exit 2; }
target="$(realpath -m "$1")"
cd "$(dirname "$0")/.."
python="${PYTHON:-python3}"
part="$(mktemp -d "$(dirname "$target")/.wheels-XXXXXX")"
trap 'rm -rf "$part"' EXIT
mkdir "$part/wheels"
"$python" -m venv "$part/venv"
pip=("$part/venv/bin/python" -m pip --quiet --disable-pip-version-check --no-input)
"${pip[@]}" download --require-hashes --no-deps --only-binary :all: -d "$part/wheels" -r requirements.lock -r deploy/requirements-postgres.lock
# Abbe itself is built with the setuptools of the lock.
"${pip[@]}" install --upgrade --no-index --no-deps "$part"/wheels/setuptools-*.whl
"$part/venv/bin/python" deploy/npm_files.py
rm -rf build  # setuptools would pack what an older wheel has left there
"${pip[@]}" wheel --no-index --no-deps --no-build-isolation -w "$part/wheels" .
rm -rf "$part/venv"
cp requirements.lock deploy/requirements-postgres.lock deploy/abbe.service deploy/machine.example.toml deploy/abbe-sysusers.conf deploy/abbe-tmpfiles.conf deploy/99-abbe.rules "$part/"
cat >"$part/install.sh" <<'INSTALL'
#!/usr/bin/env bash
# install.sh VENV: makes or updates a virtual environment from the wheels beside this file. Nothing is fetched.
set -euo pipefail
[ $# -eq 1 ] || { echo "usage: install.sh VENV, e.g. /opt/abbe/.venv" >&2; exit 2; }
venv="$(realpath -m "$1")"
cd "$(dirname "$0")"
sha256sum --quiet --check SHA256SUMS || { echo "install.sh: a file is not as it was made; carry the folder over again" >&2; exit 1; }
[ -x "$venv/bin/python" ] || "${PYTHON:-python3}" -m venv "$venv"
pip=("$venv/bin/python" -m pip --quiet --disable-pip-version-check --no-input install --no-index --no-deps)
# Their hashes were compared with the lock files when they were fetched, and with the list just now.
"${pip[@]}" wheels/*.whl
"${pip[@]}" --force-reinstall wheels/abbe-*.whl
"$venv/bin/abbe" version
INSTALL
chmod +x "$part/install.sh"
(cd "$part" && find . -type f ! -name SHA256SUMS -printf '%P\n' | LC_ALL=C sort | xargs -d '\n' sha256sum >SHA256SUMS)
chmod 755 "$part"
mv "$part" "$target"
trap - EXIT
echo "$target: $(find "$target/wheels" -name '*.whl' | wc -l) wheels, $(du -sh "$target" | cut -f1); carry it over and run install.sh VENV"
