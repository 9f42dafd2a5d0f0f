#!/usr/bin/python3
"""Network cameras by GStreamer, for tests: /h264 (no picture waits for a later one), /reordered
(pictures that build on later ones), /main (a profile in which they might), /jpeg, /h265. What they report is when they took an image, and
that image is of a ball that moves.

usage: rtsp_server.py PORT none|basic|digest

Run it in a network namespace of its own.
"""
import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtsp", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtsp, GstRtspServer  # noqa: E402

# Before a class of its kind is made.
Gst.init(None)
SIZE = "video/x-raw,width=640,height=480,framerate=30/1,format=I420"
BALL = f"videotestsrc is-live=true pattern=ball ! {SIZE}"
STREAMS = {
    "/h264": "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=30"
    " ! rtph264pay name=pay0 pt=96 config-interval=1",
    "/reordered": "x264enc bframes=2 rc-lookahead=4 speed-preset=veryfast key-int-max=30"
    " ! video/x-h264,profile=main ! rtph264pay name=pay0 pt=96 config-interval=1",
    "/main": "x264enc tune=zerolatency speed-preset=veryfast key-int-max=30"
    " ! video/x-h264,profile=main ! rtph264pay name=pay0 pt=96 config-interval=1",
    "/jpeg": "jpegenc ! rtpjpegpay name=pay0 pt=26",
    "/h265": "x265enc tune=zerolatency speed-preset=ultrafast key-int-max=30"
    " ! rtph265pay name=pay0 pt=96",
}
USER, PASSWORD = "eye", "secret"


class Camera(GstRtspServer.RTSPMedia):
    """Reports the time of the image, and not that of sending."""

    def do_setup_rtpbin(self, rtpbin):
        rtpbin.set_property("rtcp-sync-send-time", False)
        rtpbin.set_property("ntp-time-source", 0)
        return True


def authentication(kind):
    token = GstRtspServer.RTSPToken()
    token.set_string("media.factory.role", "watcher")
    gate = GstRtspServer.RTSPAuth()
    if kind == "basic":
        gate.add_basic(GstRtspServer.RTSPAuth.make_basic(USER, PASSWORD), token)
    else:
        gate.set_supported_methods(GstRtsp.RTSPAuthMethod.DIGEST)
        gate.add_digest(USER, PASSWORD, token)
    return gate


def main():
    port, kind = sys.argv[1:]
    server = GstRtspServer.RTSPServer()
    server.set_address("127.0.0.1")
    server.set_service(port)
    for path, stream in STREAMS.items():
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(f"( {BALL} ! {stream} )")
        factory.set_media_gtype(Camera.__gtype__)
        factory.set_shared(True)
        factory.set_latency(0)
        if kind != "none":
            may = GstRtspServer.RTSPPermissions()
            for what in ("access", "construct"):
                may.add_permission_for_role("watcher", f"media.factory.{what}", True)
            factory.set_permissions(may)
        server.get_mount_points().add_factory(path, factory)
    if kind != "none":
        server.set_auth(authentication(kind))
    server.attach(None)
    print("ready", flush=True)
    GLib.MainLoop().run()


main()
