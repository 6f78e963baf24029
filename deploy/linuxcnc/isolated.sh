#!/bin/sh
# start.sh in namespaces of its own (network, IPC, processes, mounts), so that several can run on one computer: isolated.sh RUNDIR [PORT].
# Needs root. A listening socket handed over as file descriptor $ABBE_LISTEN_FD stays reachable from outside.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
mkdir -p "${1:?isolated.sh RUNDIR [PORT]}"
run=$(cd "$1" && pwd)
export ABBE_HERE="$here" ABBE_RUN="$run"
# A temporary folder of its own hides the lock file of other instances; what we need of the old one is put back at its place.
exec unshare -n -i -p -f -m --mount-proc --kill-child sh -euc '
    mount --make-rprivate /
    mount --bind /tmp /mnt
    mount -t tmpfs tmpfs /tmp
    for path in "$ABBE_HERE" "$ABBE_RUN"; do
        case "$path" in /tmp/*) mkdir -p "$path"; mount --bind "/mnt/${path#/tmp/}" "$path";; esac
    done
    umount -l /mnt
    exec "$ABBE_HERE/start.sh" "$ABBE_RUN" "$@"' sh "${2:-15021}"
