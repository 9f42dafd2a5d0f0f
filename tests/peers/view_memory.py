"""What an hour of live view takes of memory: Rerun's viewer as `crossfix view` starts it, and `view` itself.

usage: view_memory.py CROSSFIX RERUN RECORDING [SPEED]

RECORDING holds bearings and tracks, of an hour say (`crossfix replay --fuse -o`); it is played SPEED times as fast
as life (20), as what is drawn goes by the time of the data. RERUN is the viewer of PyPI's rerun-sdk of the version
that Crossfix is built with; it draws without a screen (Vulkan, such as Debian's mesa-vulkan-drivers).
"""
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import time


def free_ports(count):
    held = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    return [one.getsockname()[1] for one in held]


def memory_mb(pid):
    with open(f"/proc/{pid}/status") as status:
        return int(re.search(r"VmRSS:\s+(\d+)", status.read()).group(1)) / 1024


def children(pid):
    """A process and all that it has started."""
    found = [pid]
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            with open(f"/proc/{name}/stat") as stat:
                parent = int(stat.read().rsplit(")", 1)[1].split()[1])
        except OSError:
            continue
        if parent == pid:
            found += children(int(name))
    return found


crossfix, rerun, recording = map(os.path.abspath, sys.argv[1:4])
speed = float(sys.argv[4]) if len(sys.argv) > 4 else 20.0
info = subprocess.run([crossfix, "info", recording], check=True, capture_output=True, text=True).stdout
site = re.search(r"crossfix/([^/]+)/", info).group(1)
cameras = sorted(set(re.findall(r"crossfix/[^/]+/([^/]+)/bearings", info)))
with tempfile.TemporaryDirectory() as folder:
    fusion, *ports = free_ports(1 + len(cameras))
    network = os.path.join(folder, "network.toml")
    with open(network, "w") as file:
        file.write(f'site = "{site}"\nfusion = "tcp/127.0.0.1:{fusion}"\n[cameras]\n')
        file.writelines(f'{name} = "tcp/127.0.0.1:{port}"\n' for name, port in zip(cameras, ports))
    # `view` starts whatever is called rerun; this one needs no screen.
    wrapper = os.path.join(folder, "rerun")
    with open(wrapper, "w") as file:
        file.write(f'#!/bin/sh\nexec "{rerun}" --headless "$@"\n')
    os.chmod(wrapper, 0o755)
    environment = dict(os.environ, PATH=f"{folder}:{os.environ['PATH']}")
    view = subprocess.Popen([crossfix, "-q", "view", "-c", network], env=environment)
    time.sleep(5)
    replay = subprocess.Popen([crossfix, "-q", "replay", recording, "--network", network, "--tracks",
                               "--speed", str(speed)])
    most = [0.0, 0.0]
    while replay.poll() is None and view.poll() is None:
        started = [pid for pid in children(view.pid) if pid != view.pid]
        now = [memory_mb(view.pid), sum(memory_mb(pid) for pid in started)]
        most = [max(pair) for pair in zip(most, now)]
        time.sleep(2)
    left = children(view.pid)
    for process in (replay, view):
        process.terminate()
        process.wait()
    # The viewer outlives whoever started it.
    for pid in left[1:]:
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
print(f"view: {most[0]:.0f} MB at most, the viewer: {most[1]:.0f} MB at most")
