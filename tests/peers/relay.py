#!/usr/bin/python3
"""A cable between two network namespaces that it makes, which delays, reorders and loses packets.

usage: relay.py NAME=ADDRESS NAME=ADDRESS       (e.g. near=10.0.0.1 far=10.0.0.2; needs root, `ip` and /dev/net/tun)

Each namespace has one interface, of the same name and with that address of a network of 256. Says `up` when they are
there. Each line of stdin says how the cable is from then on: DELAY_S JITTER_S LOSS, e.g. `0.1 0.02 0.05`: 80 to 120 ms
each way, and each packet by itself, so that they overtake one another; one of twenty is lost, by a fixed seed.
`0 0 1` is a cut cable, `0 0 0` what it begins as. Says `so` to each line. All vanishes when stdin ends.
"""
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import sys
import time

TUNSETIFF, IFF_TUN, IFF_NO_PI = 0x400454CA, 1, 0x1000


def ip(arguments):
    subprocess.run(["ip", *arguments.split()], check=True, stderr=subprocess.DEVNULL)


def end_of_cable(name, address):
    """A namespace with an interface, which is ours to read and to write."""
    ip(f"netns add {name}")
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(device, TUNSETIFF, struct.pack("16sH", name.encode(), IFF_TUN | IFF_NO_PI))
    ip(f"link set {name} netns {name}")
    ip(f"-n {name} link set lo up")
    ip(f"-n {name} addr add {address}/24 dev {name}")
    ip(f"-n {name} link set {name} up")
    return device


def packets(device):
    """What waits on an interface."""
    try:
        while True:
            yield os.read(device, 1 << 16)
    except OSError:
        # Nothing more, or it is down.
        return


def relay(near, far):
    other = {near: far, far: near}
    delay_s, jitter_s, loss = 0.0, 0.0, 0.0
    chance = random.Random(1)
    on_the_way, number, typed = [], 0, b""
    while True:
        until = max(0.0, on_the_way[0][0] - time.monotonic()) if on_the_way else None
        ready, _, _ = select.select([near, far, sys.stdin], [], [], until)
        if sys.stdin in ready:
            heard = os.read(sys.stdin.fileno(), 4096)
            if not heard:
                return
            *lines, typed = (typed + heard).split(b"\n")
            for line in lines:
                delay_s, jitter_s, loss = map(float, line.split())
                print("so", flush=True)
        now = time.monotonic()
        for device in (near, far):
            for packet in packets(device) if device in ready else ():
                if chance.random() >= loss:
                    due = now + delay_s + chance.uniform(-jitter_s, jitter_s)
                    heapq.heappush(on_the_way, (due, number, other[device], packet))
                    number += 1
        while on_the_way and on_the_way[0][0] <= time.monotonic():
            _, _, device, packet = heapq.heappop(on_the_way)
            try:
                os.write(device, packet)
            except OSError:
                # It is full, or down: as a cable would have it.
                pass


ends = [end.split("=") for end in sys.argv[1:3]]
try:
    devices = [end_of_cable(name, address) for name, address in ends]
    print("up", flush=True)
    relay(*devices)
finally:
    for name, _ in ends:
        subprocess.run(["ip", "netns", "del", name], stderr=subprocess.DEVNULL)
