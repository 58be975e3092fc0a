# Runs inside the guest: a stack on vcan0 beside can-utils. Writes what happened to $WORK; the test judges it.
set -u
cd /tmp
COUNT=10000

cat >stack.toml <<'STACK'
[stack]
name = "uml"

[[service]]
name = "can0"
kind = "can"
backend = "socketcan"
interface = "vcan0"
serve = { socketcand = "127.0.0.1:29536" }

[[service]]
name = "some"
kind = "can"
backend = "socketcan"
interface = "vcan0"
filters = ["5A0:7F0", "1F000000:1FFFFF00"]

[[service]]
name = "kern"
kind = "can"
backend = "socketcan"
interface = "kslcan"
bitrate = "250k"

[[service]]
name = "gone"
kind = "can"
backend = "socketcan"
interface = "nocan7"

[[service]]
name = "virt"
kind = "can"
backend = "virtual"
serve = { slcan_pty = "slcan" }

[[service]]
name = "adapter"
kind = "can"
backend = "slcan"
interface = "/tmp/slcan2"

[[service]]
name = "far"
kind = "can"
backend = "virtual"
serve = { slcan_pty = "slcan2" }
STACK

say() { echo "--- $(date +%s.%N) $*"; }
# Waits until a command succeeds; at least two minutes.
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
health() { "$DINRAIL" ps --json | python3 -c 'import json,sys; print(next(r["health"] for r in json.load(sys.stdin) if r["service"] == sys.argv[1]))' "$1"; }
is() { [ "$(health "$1")" = "$2" ]; }
lines() { [ "$(wc -l <"$1")" -ge "$2" ]; }
# A dump listens when it shows a mark, which a bus of the stack sends until then. The test passes over marks.
marked() { "$DINRAIL" can send "$2" "$3" && sleep 0.1 && grep -q "$3" "$1"; }
listens() { until_ok "$1 listens" marked "$1" "$2" "${3:-7F0#AA}"; }
# candump listens when the kernel has one listener to everything more than before.
listeners() { grep -c ' raw' /proc/net/can/rcvlist_all; }
more_than() { [ "$(listeners)" -gt "$1" ]; }

"$DINRAIL" up stack.toml >"$WORK/up.log" 2>&1 &
until_ok "the driver works" is can0 ready
until_ok "the driver with filters works" is some ready
until_ok "a missing interface does not stop the stack" is gone degraded
until_ok "the serial adapter works" is adapter ready

say "own transmissions"
"$DINRAIL" can dump can0 --json >"$WORK/own.dump" 2>&1 &
dump=$!
listens "$WORK/own.dump" can0
before=$(listeners)
candump -L vcan0 >"$WORK/own.candump" &
own=$!
until_ok "candump listens" more_than "$before"
frames=()
for i in $(seq 0 199); do frames+=("$(printf '%03X#%08X' $((i * 7 % 2048)) "$i")"); done
frames+=(1ABCDEF0#0102030405060708 123#R4 7FF# "321##1$(printf 'A5%.0s' $(seq 64))" '1ABCDEF0##0')
printf '%s\n' "${frames[@]}" >"$WORK/own.sent"
"$DINRAIL" can send can0 "${frames[@]}" >"$WORK/own.send" 2>&1
until_ok "candump saw them" lines "$WORK/own.candump" "${#frames[@]}"

say "frames of others: FD, remote, error"
cansend vcan0 123##3AABBCC
cansend vcan0 456#R2
cansend vcan0 20000204#0020000000008000
cansend vcan0 20000040#0000000000000000
cansend vcan0 20000100#0000000000000000
cansend vcan0 20000020#0000000000000000
cansend vcan0 00000777#01
until_ok "the stack saw them" grep -q '00000777#01' "$WORK/own.dump"
sleep 0.5
kill $own $dump

say "filters in the kernel"
"$DINRAIL" can dump some >"$WORK/some.dump" 2>&1 &
dump=$!
"$DINRAIL" can dump can0 >"$WORK/all.dump" 2>&1 &
all=$!
listens "$WORK/all.dump" can0
# These are frames of another sender to can0: the test counts them.
listens "$WORK/some.dump" some 7F1#AA
for frame in 5A1#01 123#02 1F0000AA#03 000005A1#04 5AF#R2 5B0#05 1F0001AA#06 20000080#0000000000000000; do
    cansend vcan0 "$frame"
done
# Its own frames have an echo of the kernel when they pass the filters, and one of the driver when they do not.
"$DINRAIL" can send some 5A2#0A 124#0B >"$WORK/some.send" 2>&1
until_ok "the other driver saw all" grep -q '124#0B' "$WORK/all.dump"
until_ok "the driver with filters saw its own" grep -q '124#0B' "$WORK/some.dump"
kill $dump $all

say "$COUNT frames each way at 2000/s"
python3 - "$COUNT" >in.log <<'PY'
import sys
for i in range(int(sys.argv[1])):
    print(f"({1700000000 + i / 2000:.6f}) c {i % 2048:03X}#{i:08X}")
PY
"$DINRAIL" can dump can0 >in.dump 2>"$WORK/in.dump.err" &
dump=$!
listens in.dump can0
before=$(listeners)
# A receive buffer that lets it sleep for seconds on this one processor.
candump -r 33554432 -L vcan0 >out.candump 2>"$WORK/out.candump.err" &
out=$!
until_ok "candump listens" more_than "$before"
canplayer -I in.log vcan0=c &
player=$!
python3 - "$COUNT" <<'PY'
import socket, sys, time
s = socket.create_connection(("127.0.0.1", 29536))
def answer():
    text = b""
    while not text.endswith(b">"):
        text += s.recv(64)
    return text
assert answer() == b"< hi >"
for command in (b"< open can0 >", b"< rawmode >"):
    s.sendall(command)
    assert answer() == b"< ok >"
s.sendall(b"< bcmmode >")
start = time.monotonic()
for i in range(int(sys.argv[1])):
    s.sendall(b"< send %08X 4 %x %x %x %x >" % (0x10000 + i % 2048, *i.to_bytes(4, "big")))
    if i % 20 == 19:
        time.sleep(max(0, start + (i + 1) / 2000 - time.monotonic()))
# When this is answered all before it was read.
s.sendall(b"< echo >")
text = b""
while b"< echo >" not in text:
    text += s.recv(64)
PY
wait $player
until_ok "candump saw both directions" lines out.candump $((2 * COUNT))
until_ok "the stack saw both directions" lines in.dump $((2 * COUNT + $(grep -c '7F0#AA' in.dump)))
kill $out $dump
cp out.candump in.dump "$WORK"

say "down and up again"
"$DINRAIL" can dump can0 >"$WORK/updown.dump" 2>&1 &
dump=$!
listens "$WORK/updown.dump" can0
for round in 1 2 3; do
    ip link set vcan0 down
    until_ok "down $round seen" is can0 degraded
    "$DINRAIL" can send can0 "00A#0$round" >>"$WORK/down.send" 2>&1
    ip link set vcan0 up
    until_ok "up $round seen" is can0 ready
    cansend vcan0 "70$round#"
    until_ok "frame $round after it" grep -q "70$round#" "$WORK/updown.dump"
    "$DINRAIL" can send can0 "00B#0$round" >>"$WORK/up.send" 2>&1
done
say "deleted and made again"
ip link del vcan0
until_ok "gone seen" is can0 degraded
ip link add dev vcan0 type vcan mtu 72
# Raised by the driver, which may.
until_ok "back" is can0 ready
"$DINRAIL" can send can0 "00C#01" >>"$WORK/up.send" 2>&1
kill $dump

say "a controller: bit rate by netlink, bus-off, pulled and plugged in"
plug() {
    python3 "$UML/fake_adapter.py" /tmp/fake "$WORK/fake.log" &
    fake=$!
    until_ok "the adapter's terminal" test -e /tmp/fake
    slcand -F "$(readlink /tmp/fake)" kslcan >>"$WORK/slcand.log" 2>&1 &
    slcand=$!
}
for round in 1 2; do
    plug
    until_ok "interface raised $round" is kern ready
    ip -details link show kslcan >"$WORK/kslcan.$round"
    "$DINRAIL" can send kern "10$round#01" >>"$WORK/kern.send" 2>&1
    until_ok "on the adapter $round" grep -q "^t10${round}101" "$WORK/fake.log"
    if [ $round = 1 ]; then
        "$DINRAIL" can send kern 666#02 >>"$WORK/kern.send" 2>&1
        until_ok "bus-off seen" grep -q "kslcan is bus-off" "$WORK/up.log"
        until_ok "opened again" sh -c "[ \$(grep -c '^O\$' $WORK/fake.log) -ge 2 ]"
        until_ok "restarted" is kern ready
        "$DINRAIL" can send kern 200#03 >>"$WORK/kern.send" 2>&1
        until_ok "works again" grep -q '^t200103' "$WORK/fake.log"
    fi
    kill $slcand; wait $slcand 2>/dev/null
    kill $fake; wait $fake 2>/dev/null
    rm -f /tmp/fake
    until_ok "pulled $round" is kern degraded
done

say "slcand on our terminal"
"$DINRAIL" can dump virt >"$WORK/virt.dump" 2>&1 &
dump=$!
slcand -o -s6 "$(readlink /tmp/slcan)" slcan0
until_ok "slcan0 is there" ip link set slcan0 up
before=$(listeners)
candump -L slcan0 >"$WORK/slcan0.candump" &
candumped=$!
until_ok "candump listens to slcan0" more_than "$before"
until_ok "a frame of slcand" sh -c "cansend slcan0 321#1122; sleep 0.2; grep -q '321#1122' $WORK/virt.dump"
cansend slcan0 1ABCDEF0#0102030405060708
cansend slcan0 123#R3
until_ok "a remote frame of slcand" grep -q '123#R3' "$WORK/virt.dump"
"$DINRAIL" can send virt 7AB#01 1BCDEF01# 055#R2 >"$WORK/virt.send" 2>&1
until_ok "frames to slcand" grep -q '055#R2' "$WORK/slcan0.candump"
kill $dump $candumped
kill "$(pidof slcand)"

say "our SLCAN client on our terminal"
"$DINRAIL" can dump far >"$WORK/far.dump" 2>&1 &
dump=$!
listens "$WORK/far.dump" far
"$DINRAIL" can send adapter 123#01 1ABCDEF0#02 >"$WORK/adapter.send" 2>&1
until_ok "frames by the adapter" grep -q '1ABCDEF0#02' "$WORK/far.dump"
kill $dump
"$DINRAIL" down
wait
say "end"
