# Runs inside the guest: the log of a real car through the kernel. canplayer plays it to vcan0, where the stack of $WORK
# decodes and records it; then the recording is played to vcan0 again, where candump listens. The test judges.
set -u
say() { echo "--- $(date +%s.%N) $*"; }
until_ok() {
    local what=$1 i
    shift
    for i in $(seq 1200); do
        if "$@" >/dev/null 2>&1; then say "ok: $what"; return 0; fi
        sleep 0.1
    done
    say "IN VAIN: $what"
    echo "$what" >>"$WORK/in_vain"
    return 1
}
ready() { "$DINRAIL" ps --json | python3 -c 'import json,sys; sys.exit(any(r["health"] != "ready" for r in json.load(sys.stdin)))'; }
lines() { [ "$(wc -l <"$1")" -ge "$2" ]; }
registers() { [ "$("$PYTHON" "$UML/../peers/modbus_read.py" 1502 holding 0 8)" = "$(cat "$WORK/registers")" ]; }

mkdir /tmp/car && cd /tmp/car && cp "$WORK/stack.toml" "$WORK/car.st" .
COUNT=$(wc -l <"$WORK/played.log")
"$DINRAIL" up stack.toml >"$WORK/up.log" 2>&1 &
up=$!
until_ok "the stack works" ready
canplayer -I "$WORK/played.log" vcan0=c
until_ok "the registers are those of the last frames" registers
"$DINRAIL" down
wait $up
cp recordings/*.mcap "$WORK"

say "the recording is played to the bus again"
cat >again.toml <<'STACK'
[stack]
name = "again"

[[service]]
name = "can0"
kind = "can"
backend = "socketcan"
interface = "vcan0"
STACK
"$DINRAIL" up again.toml >"$WORK/again.log" 2>&1 &
up=$!
until_ok "the second stack works" ready
listeners() { grep -c ' raw' /proc/net/can/rcvlist_all; }
more_than() { [ "$(listeners)" -gt "$1" ]; }
before=$(listeners)
candump -r 33554432 -L vcan0 >again.candump &
candump=$!
until_ok "candump listens" more_than "$before"
"$DINRAIL" can replay recordings/*.mcap --bus can0 >"$WORK/again.replay" 2>&1
echo "exit $?" >>"$WORK/again.replay"
until_ok "candump saw it all" lines again.candump "$COUNT"
kill $candump
cp again.candump "$WORK"
"$DINRAIL" down
wait $up
say "end"
