#!/usr/bin/env bash
# Installs a release in a bare Debian by the very lines of docs/hospital-it.md, and starts what the units for systemd start.
#   docker/check_install.sh WHEEL
# Needs root, debootstrap (apt-get install debootstrap), the network, some minutes and, in CHECK_INSTALL_DIR (default: a
# folder that is removed at the end), 4 GB of disk. MIRROR names a mirror of Debian, PIP_CONF a pip.conf.
set -euo pipefail
cd "$(dirname "$0")/.."

wheel=${1:?the wheel of the release}
[ "$(id -u)" = 0 ] || { echo "This has to run as root: it makes a root file system." >&2; exit 1; }
command -v debootstrap >/dev/null || { echo "There is no debootstrap: apt-get install debootstrap" >&2; exit 1; }
# Mounts are made in a name space of this script's own, and go with it.
[ -n "${CHECK_INSTALL_INSIDE:-}" ] || exec env CHECK_INSTALL_INSIDE=1 unshare --mount --pid --fork --kill-child "$0" "$@"

if [ -n "${CHECK_INSTALL_DIR:-}" ]; then
    work=$CHECK_INSTALL_DIR
    mkdir -p "$work"
else
    work=$(mktemp -d)
    trap 'umount --recursive "$work/root"/{proc,dev,etc/ssl/certs} 2>/dev/null || true; rm -rf --one-file-system "$work"' EXIT
fi
root=$work/root

echo "== bare Debian 13"
[ -e "$root/etc/debian_version" ] || debootstrap --variant=minbase --include=ca-certificates trixie "$root" \
    "${MIRROR:-http://deb.debian.org/debian}" >"$work/debootstrap.log"
mount -t proc proc "$root/proc"
mount --rbind /dev "$root/dev"
cp --remove-destination /etc/resolv.conf /etc/hosts "$root/etc/"
# Where outgoing TLS is inspected, the installation trusts the certificates that this machine trusts.
[ -z "${SSL_CERT_FILE:-}" ] || mount --rbind "$(dirname "$SSL_CERT_FILE")" "$root/etc/ssl/certs"
[ -z "${PIP_CONF:-}" ] || cp "$PIP_CONF" "$root/etc/pip.conf"
rm -rf "$root/release"
mkdir "$root/release"
cp -r "$wheel" requirements.lock docker/systemd samples "$root/release/"

# In the new system, with nothing of this one's environment.
inside=(env -i PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin LANG=C.UTF-8 DEBIAN_FRONTEND=noninteractive
    PIP_ROOT_USER_ACTION=ignore chroot "$root")
# As the units run it, but for what only systemd can do.
as_unit=("${inside[@]}" setpriv --reuid specimap --regid specimap --clear-groups --no-new-privs --bounding-set=-all
    env SPECIMAP_DATA_DIR=/var/lib/specimap SPECIMAP_PORT="${CHECK_PORT:-18766}" sh -c 'umask 0077; exec $0')

# lines MARK: the commands between the marks of the page.
lines() {
    sed -n "/^<!-- $1 -->\$/,/^<!-- \/$1 -->\$/p" docs/hospital-it.md | grep -v -e '^<!--' -e '^```'
}

echo "== the lines of docs/hospital-it.md"
start=$SECONDS
"${inside[@]}" sh -euxc "cd /release; $(lines install)" >"$work/install.log" 2>&1 || { tail -n 30 "$work/install.log" >&2; exit 1; }
echo "installed in $((SECONDS - start)) s: $(du -sh "$root/opt/specimap" | cut -f1)"
key=$("${inside[@]}" sh -euc "$(lines start)" | grep '^spk_')

# unit NAME: the command of a unit, with %i as 1.
unit() {
    sed -n 's/^ExecStart=//p' "$root/etc/systemd/system/$1" | sed 's/%i/1/'
}

echo "== the service"
"${as_unit[@]}" "$(unit specimap.service)" >"$work/service.log" 2>&1 &
service=$!
"${as_unit[@]}" "$(unit specimap-worker@.service)" >"$work/worker.log" 2>&1 &
worker=$!
"${inside[@]}" /opt/specimap/.venv/bin/python - "$key" "${CHECK_PORT:-18766}" <<'END' || { cat "$work"/service.log "$work"/worker.log >&2; exit 1; }
import json, sys, time, urllib.error, urllib.request
key, port = sys.argv[1:]

def ask(path):
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers={"Authorization": f"Bearer {key}"})
    with urllib.request.build_opener(urllib.request.ProxyHandler({})).open(request, timeout=5) as answer:
        return answer.read()

start = time.monotonic()
while True:
    try:
        if json.loads(ask("/readyz")) == {"status": "ready", "workers": 1}:
            break
    except (urllib.error.URLError, ConnectionError):
        pass
    assert time.monotonic() < start + 60, "not ready after 60 s"
    time.sleep(0.2)
assert [each["name"] for each in json.loads(ask("/v1/keys"))] == ["administrator"]
assert b"<html" in ask("/").lower()
print(f"ready after {time.monotonic() - start:.1f} s, pages and key included")
END
"${as_unit[@]}" "/opt/specimap/.venv/bin/specimap worker --health"
[ "$("${inside[@]}" stat -c '%U %a' /var/lib/specimap/specimap.db)" = "specimap 600" ] || { echo "the database is open to others" >&2; exit 1; }
kill -TERM $service $worker
wait $service && wait $worker || { echo "did not end in order" >&2; cat "$work"/service.log "$work"/worker.log >&2; exit 1; }

echo "== the sample"
"${inside[@]}" /opt/specimap/.venv/bin/specimap run --photos /release/samples/rgb --cube /release/samples/hsi/hsi.hdr --out /tmp/out --json | tail -n 1 |
    python3 -c 'import json, sys; print(json.loads(sys.stdin.read())["report"]["coverage"]["points"], "points")'
echo "== all checked"
