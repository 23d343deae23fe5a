#!/usr/bin/env bash
# Builds the images without a Docker engine, and runs what is in them: for machines that reach only the package archives
# of Debian, Python and npm. Debian 13 with its own Python replaces the base image; the rest is the Dockerfile.
#   docker/check_images.sh [service|worker-cpu|worker-gpu ...]        (default: service worker-cpu)
# Needs root, buildah and debootstrap (apt-get install buildah debootstrap), the network, some minutes and, in
# CHECK_IMAGES_DIR (default: a folder that is removed at the end), up to 30 GB of disk.
set -euo pipefail
cd "$(dirname "$0")/.."

targets=("$@")
[ ${#targets[@]} -gt 0 ] || targets=(service worker-cpu)
[ "$(id -u)" = 0 ] || { echo "This has to run as root: it makes root file systems." >&2; exit 1; }
for tool in buildah debootstrap; do
    command -v $tool >/dev/null || { echo "There is no $tool: apt-get install buildah debootstrap" >&2; exit 1; }
done

if [ -n "${CHECK_IMAGES_DIR:-}" ]; then
    work=$CHECK_IMAGES_DIR
    mkdir -p "$work"
else
    work=$(mktemp -d)
    trap 'rm -rf "$work"' EXIT
fi
export BUILDAH_ISOLATION=chroot STORAGE_DRIVER="${STORAGE_DRIVER:-vfs}"
tool=(buildah --root "$work/store" --runroot "$work/run")
base=localhost/python-stand-in

# Where outgoing TLS is inspected, the builds trust the certificates that this machine trusts.
trusted=()
[ -z "${SSL_CERT_FILE:-}" ] || trusted=(--volume "$(dirname "$SSL_CERT_FILE"):/etc/ssl/certs:ro")
[ -z "${PIP_CONF:-}" ] || trusted+=(--secret "id=pip,src=$PIP_CONF")
[ -z "${NPM_CONF:-}" ] || trusted+=(--secret "id=npm,src=$NPM_CONF")

if ! "${tool[@]}" images --quiet $base >/dev/null 2>&1; then
    echo "== base: Debian 13 by debootstrap"
    [ -e "$work/base/etc/debian_version" ] || debootstrap --variant=minbase \
        --include=ca-certificates,python3,python3-pip,python3-venv trixie "$work/base" "${MIRROR:-http://deb.debian.org/debian}" \
        >"$work/debootstrap.log"
    container=$("${tool[@]}" from scratch)
    "${tool[@]}" add --quiet "$container" "$work/base" / >/dev/null
    "${tool[@]}" run "$container" -- ln -s /usr/bin/python3 /usr/local/bin/python
    "${tool[@]}" config --env PATH=/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin "$container"
    "${tool[@]}" commit --quiet --rm "$container" $base >/dev/null
fi

# in_image CONTAINER COMMAND...: run it as the image's user and in its environment.
in_image() {
    local container=$1
    shift
    "${tool[@]}" run "$container" -- "$@"
}

# configured CONTAINER NAME...: print a part of the image's configuration, as JSON.
configured() {
    local container=$1
    shift
    "${tool[@]}" inspect "$container" | python3 -c '
import json, sys
part = json.load(sys.stdin)["Docker"]["config"]
for name in sys.argv[1:]:
    part = part[name]
print(json.dumps(part))' "$@"
}

# Start the image's own command, wait until a test holds, ask it to end. The test comes from standard input: Python that
# sets `holds`; `health` is the image's health check there.
starts_and_ends() {
    local test
    test=$(cat)
    in_image "$1" env CHECK_COMMAND="$(configured "$1" Cmd)" CHECK_HEALTH="$(configured "$1" Healthcheck Test)" \
        CHECK_TEST="$test" SPECIMAP_PORT="${CHECK_PORT:-18765}" python -c '
import json, os, signal, subprocess, time
command, test = json.loads(os.environ.pop("CHECK_COMMAND")), os.environ.pop("CHECK_TEST")
start, scope = time.monotonic(), {"health": json.loads(os.environ.pop("CHECK_HEALTH"))}
with open("/tmp/log", "wb") as log:
    program = subprocess.Popen(["tini", "-s", "--", "specimap", *command], stdout=log, stderr=log)
try:
    while exec(test, scope) or not scope["holds"]:
        assert program.poll() is None, open("/tmp/log").read()
        assert time.monotonic() < start + 60, "not ready after 60 s: " + open("/tmp/log").read()
        time.sleep(0.2)
    print(f"{command}: ready after {time.monotonic() - start:.1f} s")
finally:
    program.send_signal(signal.SIGTERM)
    status = program.wait(30)
assert status == 0, f"ended with status {status}: " + open("/tmp/log").read()'
}

check_service() {
    in_image "$1" python -c '
import importlib.util, specimap_service.app, specimap_infra.migrate, cv2, h5py, pillow_heif, pyarrow, tifffile
heavy = [name for name in ("open3d", "pycolmap", "embreex") if importlib.util.find_spec(name)]
assert not heavy, heavy'
    starts_and_ends "$1" <<'END'
import subprocess
holds = subprocess.run(health[1:], stderr=subprocess.DEVNULL).returncode == 0
END
}

check_worker() {
    in_image "$1" python -c '
import cv2, embreex, open3d, pycolmap, scipy, tensorstore, specimap_workers.worker
print("COLMAP", pycolmap.__version__)'
    starts_and_ends "$1" <<'END'
import os, sqlite3, subprocess
holds = os.path.exists("/data/specimap.db")
if holds:
    database = sqlite3.connect("file:/data/specimap.db?mode=ro", uri=True, timeout=10)
    tables = database.execute("SELECT count(*) FROM sqlite_master WHERE name = 'leases'").fetchone()[0]
    holds = tables and database.execute("SELECT count(*) FROM leases").fetchone()[0] == 1
    database.close()
holds = holds and subprocess.run(health[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode == 0
END
    cp -r samples "$("${tool[@]}" mount "$1")/samples"
    in_image "$1" specimap run --photos /samples/rgb --cube /samples/hsi/hsi.hdr --out /tmp/out --json | python3 -c '
import json, sys
*_, last = map(json.loads, sys.stdin)
report = last["report"]
print("sample:", report["coverage"]["points"], "points,", round(sum(report["seconds"].values())), "s")'
}

for target in "${targets[@]}"; do
    echo "== $target"
    start=$SECONDS
    "${tool[@]}" build --quiet --layers --format docker --file docker/Dockerfile --ignorefile docker/Dockerfile.dockerignore \
        --target "$target" --build-arg PYTHON_IMAGE=$base "${trusted[@]}" --tag "localhost/specimap-$target" . >/dev/null
    echo "built in $((SECONDS - start)) s"
    echo "with its base: $("${tool[@]}" images --noheading --format '{{.Size}}' "localhost/specimap-$target")"
    container=$("${tool[@]}" from "localhost/specimap-$target")
    [ "$(in_image "$container" id -u)" = 10001 ] || { echo "$target does not run as user 10001" >&2; exit 1; }
    in_image "$container" specimap --version
    in_image "$container" du -sh /opt/specimap
    in_image "$container" sh -c '! touch /opt/specimap/x 2>/dev/null && touch /data/x && rm /data/x'
    "${PYTHON:-python3}" docker/sbom.py image "specimap-$target" "$("${tool[@]}" mount "$container")"
    if [ "$target" = service ]; then check_service "$container"; else check_worker "$container"; fi
    "${tool[@]}" rm "$container" >/dev/null
done
echo "== all checked"
