#!/usr/bin/env bash
# Makes a release in dist/: source archive, wheel, bill of materials, wheelhouse; checks them, and starts Abbe from them without a network.
#   make release                 # a dry run: nothing but dist/ is written
#   make release ARGS=--cut      # also gives the section "Unreleased" of CHANGELOG.md the version and the day
# The version is that of pyproject.toml, and the time of all files that of the last commit: the same commit gives the same bytes.
set -euo pipefail
cd "$(dirname "$0")/.."
cut=no
case "${1:-}" in --cut) cut=yes ;; "") ;; *) echo "usage: deploy/release.sh [--cut]" >&2; exit 2 ;; esac
tools="${TOOLS:-.venv-release/bin}"
version="$("$tools/python" -c 'import tomllib; print(tomllib.load(open("pyproject.toml", "rb"))["project"]["version"])')"
grep -qx "version: $version" CITATION.cff || { echo "release: CITATION.cff does not say version $version" >&2; exit 1; }
grep -q '^## Unreleased$' CHANGELOG.md || grep -q "^## $version " CHANGELOG.md || { echo "release: CHANGELOG.md does not tell of $version" >&2; exit 1; }
SOURCE_DATE_EPOCH="$(git log -1 --format=%ct 2>/dev/null || echo 1767225600)"
export SOURCE_DATE_EPOCH
"$tools/python" deploy/npm_files.py
scratch="$(mktemp -d)"
trap 'rm -rf "$scratch"' EXIT

# Built twice, each from what git and npm have: the same bytes prove that nothing of this computer is in them.
for n in 1 2; do
    mkdir "$scratch/$n"
    git archive HEAD | tar -x -C "$scratch/$n"
    cp -r service/web/static/uplot "$scratch/$n/service/web/static/"
    cp -r service/plant/opcua/nodesets "$scratch/$n/service/plant/opcua/"
    cp -r service/rendering/fonts "$scratch/$n/service/rendering/"
    (cd "$scratch/$n" && umask 022 && "$OLDPWD/$tools/python" -m build --no-isolation --wheel . >../build.log 2>&1) || { cat "$scratch/build.log" >&2; exit 1; }
done
cmp "$scratch"/1/dist/*.whl "$scratch"/2/dist/*.whl
(cd "$scratch/1" && umask 022 && "$OLDPWD/$tools/python" -m build --no-isolation --sdist . >../build.log 2>&1) || { cat "$scratch/build.log" >&2; exit 1; }
rm -rf dist
mkdir dist
cp "$scratch"/1/dist/* dist/

"$tools/twine" check --strict dist/*
"$tools/check-wheel-contents" dist/*.whl
# 8 of 10: it misses an address of the project and of its authors, which whoever publishes Abbe gives.
"$tools/pyroma" --min 8 "dist/abbe-$version.tar.gz"
"$tools/cyclonedx-py" requirements requirements.lock --pyproject pyproject.toml --mc-type application --output-reproducible --of JSON -o "dist/abbe-$version.cdx.json"

deploy/wheelhouse.sh "dist/abbe-$version-wheels" >/dev/null
# No way to an index: what is missing in the wheelhouse shows itself here.
PIP_NO_INDEX=1 "dist/abbe-$version-wheels/install.sh" "$scratch/venv"
(cd "$scratch" && venv/bin/abbe demo --seed 1 --speed "${SPEED:-60}" | tail -3)
if [ "$cut" = yes ]; then sed -i "s/^## Unreleased$/## $version - $(date -u +%F)/" CHANGELOG.md; fi
(cd dist && find . -maxdepth 1 -type f ! -name SHA256SUMS -printf '%P\n' | LC_ALL=C sort | xargs sha256sum | tee SHA256SUMS)
echo "dist/: Abbe $version is ready; nothing was published, and $([ "$cut" = yes ] && echo "CHANGELOG.md has its day: commit it and set the tag v$version" || echo "CHANGELOG.md is unchanged")"
