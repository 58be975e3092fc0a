#!/usr/bin/env python3
"""Writes conveyor.log: 20 s of a small conveyor's CAN bus as a candump log, always the same bytes.

  1A0  every 20 ms   drive status: speed u16 little-endian in 0.1 rpm, state u8, alive counter u8
  2B0  every 200 ms  motor: temperature i16 little-endian in 0.1 degC, current u16 little-endian in mA
  0F1  on change     operator panel and light barrier: bit 0 start, bit 1 stop, bit 2 parcel in the barrier
"""
import math
import pathlib

START = 1_700_000_000.0
frames = []
for n in range(1000):
    t = n * 0.020
    speed = int(1500 + 400 * math.sin(t * math.pi / 10))
    state = 2 if speed > 1200 else 1
    frames.append((t, 0x1A0, speed.to_bytes(2, "little") + bytes([state, n % 256])))
for n in range(100):
    t = n * 0.2 + 0.003
    temperature = int(450 + 180 * math.sin(t * math.pi / 20))
    current = int(2300 + 300 * math.sin(t))
    frames.append((t, 0x2B0, temperature.to_bytes(2, "little", signed=True) + current.to_bytes(2, "little")))
for n in range(26):
    t = 0.5 + n * 0.75
    frames.append((t + 0.007, 0x0F1, bytes([0x04])))
    frames.append((t + 0.157, 0x0F1, bytes([0x00])))
frames.sort(key=lambda f: f[0])
lines = [f"({START + t:.6f}) can0 {ident:03X}#{data.hex().upper()}\n" for t, ident, data in frames if t < 20.0]
pathlib.Path(__file__).with_name("conveyor.log").write_text("".join(lines))
