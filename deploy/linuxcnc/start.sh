#!/bin/sh
# Start LinuxCNC with the bridge in front of it (abbe.ini starts it) and wait until it ends: start.sh RUNDIR [PORT]. RUNDIR is made and kept: it holds the
# configuration, the tables and the logs. Give a folder with a short path (a socket lies in it).
set -eu
here=$(cd "$(dirname "$0")" && pwd)
run=${1:?start.sh RUNDIR [PORT]} port=${2:-15021}
mkdir -p "$run"
run=$(cd "$run" && pwd)
# The real-time process gives up root: it must be able to make its socket.
if [ "$(id -u)" -eq 0 ]; then export RTAPI_UID="${RTAPI_UID:-65534}"; chmod 1777 "$run"; fi
for file in abbe.ini machine.hal volumetric.hal drives.hal display.py tool.tbl; do [ -e "$run/$file" ] || cp "$here/$file" "$run/"; done
# The stock channels without their TCP port: nothing of the control listens on the network.
sed 's/TCP=5005 xdr//' /usr/share/linuxcnc/linuxcnc.nml >"$run/local.nml"
export HOME="$run" RTAPI_FIFO_PATH="$run/rtapi_fifo" ABBE_READY="$run/ready"
unset DISPLAY
cd "$run"
/usr/bin/python3 "$here/bridge.py" --prepare "$run"
printf '#!/bin/sh\nexec /usr/bin/python3 "%s/bridge.py" --rundir "%s" --port %s 2>"%s/bridge.log"\n' "$here" "$run" "$port" "$run" >bridge.sh
chmod +x bridge.sh
exec linuxcnc "$run/abbe.ini" </dev/null >"$run/linuxcnc.log" 2>&1
