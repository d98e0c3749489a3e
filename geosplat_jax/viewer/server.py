"""The viewer in a browser: a thin layer between `painter.Viewer` and viser."""

import socket
import time
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from geosplat_jax.io.extras import optional_package
from geosplat_jax.io.views import Views
from geosplat_jax.report.relight import BACKGROUNDS
from geosplat_jax.report.renderer import photograph_on_white
from geosplat_jax.viewer.looks import MODES, Look
from geosplat_jax.viewer.painter import Viewer

DEFAULT_PORT = 8080

_LOCAL = "127.0.0.1"
_RISE = 0.35
"""Wanted height of the first camera above the middle of the object, per distance from it."""
_PHOTOGRAPH = 160
"""Approximate longer side of the photographs on camera frustums, pixels."""

_REFRESH = 2.0
"""Seconds between two checks for a newer checkpoint."""

_PAUSE = 0.02
"""Seconds to wait if there is nothing to draw."""

# Quaternion (w, x, y, z) from glTF's axes, y up, to those of the scene, z up: 90 degrees about x.
_UPRIGHT = (2**-0.5, 2**-0.5, 0.0, 0.0)


class ViewerError(ValueError):
    """The viewer cannot start; the message says what to change."""


def viser_library() -> Any:
    """Return the module viser, which serves the browser.

    Raises
    ------
    ViewerError
        If viser is not installed.
    """
    return optional_package("viser", "the viewer", extra="view", error=ViewerError)


def require_free_port(port: int, host: str = _LOCAL) -> None:
    """Refuse a port that is out of range, or that this process cannot listen on.

    Raises
    ------
    ViewerError
    """
    if not 1 <= port <= 65535:
        raise ViewerError(f"a port is a number from 1 to 65535, got {port}")
    with closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise ViewerError(
                f"port {port} cannot be used ({error.strerror}); choose another with --port"
            ) from None


class _Person:
    """A connected browser: its camera, and its controls."""

    def __init__(self, client: Any, lights: tuple[str, ...]) -> None:
        self._client = client
        gui = client.gui
        self._mode = gui.add_dropdown("picture", MODES, initial_value="render")
        self._light = gui.add_dropdown("light", lights, initial_value=lights[0])
        self._turn = gui.add_slider("light turned", 0, 360, 5, 0, hint="degrees, from above")
        self._intensity = gui.add_slider("intensity", 0.0, 4.0, 0.05, 1.0)
        self._background = gui.add_dropdown("background", BACKGROUNDS, initial_value="white")
        self._status = gui.add_markdown("the first pictures wait for a compilation")

    def look(self) -> Look | None:
        """Return the look that the controls ask for; None before the window has a size."""
        camera = self._client.camera
        if not camera.image_height or not camera.image_width:
            return None
        (x, y, z), (qw, qx, qy, qz) = map(float, camera.position), map(float, camera.wxyz)
        return Look(
            position=(x, y, z),
            rotation=(qw, qx, qy, qz),
            field_of_view=float(camera.fov),
            aspect=camera.image_width / camera.image_height,
            mode=self._mode.value,
            light=self._light.value,
            turn=float(self._turn.value),
            intensity=float(self._intensity.value),
            background=self._background.value,
        )

    def show(self, viewer: Viewer) -> bool:
        """Draw and show the next picture; return whether there was one to draw."""
        look = self.look()
        next_picture = None if look is None else viewer.draw(self._client.client_id, look)
        if next_picture is None:
            return False
        self._client.scene.set_background_image(
            next_picture.rgb, format="jpeg", jpeg_quality=90, depth=next_picture.depth
        )
        level = next_picture.level
        self._status.content = (
            f"step {next_picture.step}, {level.width} x {level.height}, {level.samples} samples, "
            f"{next_picture.seconds:.2f} s"
        )
        return True


class _Things:
    """Objects in the scene beside the pictures: mesh, Gaussians and photographs.

    Mesh and Gaussians are sent when they are switched on, and again after a newer checkpoint.
    """

    def __init__(self, server: Any, viewer: Viewer, views: Views | None) -> None:
        self._server, self._viewer = server, viewer
        self._sent: dict[str, Any] = {}
        self._photographs: list[Any] = []
        with server.gui.add_folder("show"):
            boxes = {
                "mesh": server.gui.add_checkbox("mesh", False),
                "Gaussians": server.gui.add_checkbox("Gaussians", False),
            }
            cameras = server.gui.add_checkbox("photographs", False)
        self._boxes = boxes
        self._cameras = cameras
        if views is not None:
            self._add_photographs(views)
        cameras.on_update(lambda event: self._show_photographs())

    def _add_photographs(self, views: Views) -> None:
        """Put a frustum at every camera; a click on it goes there."""
        stride = max(1, max(views.height, views.width) // _PHOTOGRAPH)
        poses = np.linalg.inv(np.asarray(views.world_to_camera, np.float64))
        radius = float(np.median(np.linalg.norm(poses[:, :3, 3] - poses[:, :3, 3].mean(0), axis=1)))
        for number, (name, pose) in enumerate(zip(views.names, poses, strict=True)):
            thumbnail = photograph_on_white(np.asarray(views.images[number][::stride, ::stride]))
            field_of_view = 2.0 * np.arctan(0.5 * views.height / views.intrinsics[number, 1, 1])
            x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
            frustum = self._server.scene.add_camera_frustum(
                f"/photographs/{number:04d}",
                fov=float(field_of_view),
                aspect=views.width / views.height,
                scale=0.08 * max(radius, 1e-6),
                image=np.round(255.0 * thumbnail).astype(np.uint8),
                wxyz=(w, x, y, z),
                position=tuple(pose[:3, 3]),
                visible=False,
            )
            frustum.on_click(_to_camera(pose, float(field_of_view), name))
            self._photographs.append(frustum)

    def _show_photographs(self) -> None:
        for frustum in self._photographs:
            frustum.visible = bool(self._cameras.value)

    def update(self) -> None:
        """Send objects that were switched on, and remove those that were switched off."""
        for name, box in self._boxes.items():
            if box.value and name not in self._sent:
                self._sent[name] = self._send(name)
            elif not box.value and name in self._sent:
                self._remove(name)

    def renew(self) -> None:
        """Remove objects of an older checkpoint, so that `update` sends them again."""
        for name in tuple(self._sent):
            self._remove(name)

    def _remove(self, name: str) -> None:
        handle = self._sent.pop(name)
        if handle is not None:
            handle.remove()

    def _send(self, name: str) -> Any:
        painter, scene = self._viewer.painter, self._server.scene
        if name == "mesh":
            glb = painter.mesh_glb()
            return None if glb is None else scene.add_glb("/mesh", glb, wxyz=_UPRIGHT)
        splats = painter.gaussians()
        return scene.add_gaussian_splats(
            "/gaussians",
            centers=splats.means,
            covariances=splats.covariances,
            rgbs=splats.colors,
            opacities=splats.opacities,
        )


def _to_camera(pose: np.ndarray, field_of_view: float, name: str) -> Callable[[Any], None]:
    """Return the function that a click on a photograph calls: it moves the view to its camera."""

    def go(event: Any) -> None:
        client = event.client
        distance = float(np.linalg.norm(client.camera.look_at - client.camera.position))
        with client.atomic():
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + max(distance, 1e-3) * pose[:3, 2]
            client.camera.up_direction = -pose[:3, 1]
            client.camera.fov = field_of_view
        client.add_notification("camera", name, auto_close_seconds=2.0)

    return go


class ViewerServer:
    """A server of the viewer for browsers on this machine; any page in them can connect to it.

    Parameters
    ----------
    viewer : draws the pictures.
    views : photographs to show with their cameras; None for none.
    port : port to listen on, on this machine only.

    Raises
    ------
    ViewerError
        If viser is missing, or the port cannot be used.
    """

    def __init__(self, viewer: Viewer, views: Views | None, *, port: int = DEFAULT_PORT) -> None:
        viser = viser_library()
        require_free_port(port)
        self._viewer = viewer
        self._server = viser.ViserServer(host=_LOCAL, port=port, verbose=False)
        self.url = f"http://{_LOCAL}:{self._server.get_port()}"
        self._people: dict[int, _Person] = {}
        self._server.scene.set_up_direction("+z")
        self._look_at_the_object(views)
        self._things = _Things(self._server, viewer, views)
        self._server.on_client_connect(self._enter)
        self._server.on_client_disconnect(self._leave)
        self._refreshed = time.perf_counter()

    def _look_at_the_object(self, views: Views | None) -> None:
        """Start at the camera that looks down a little; without views, beside the object."""
        box = self._viewer.painter.trained.pipeline.surface.box
        center, camera = np.asarray(box.center, np.float64), self._server.initial_camera
        if views is None:
            camera.position = center + 3.0 * float(box.half_extent) * np.array([1.0, -1.0, 0.7])
        else:
            positions = np.linalg.inv(np.asarray(views.world_to_camera, np.float64))[:, :3, 3]
            offsets = positions - center
            elevations = offsets[:, 2] / np.maximum(np.linalg.norm(offsets, axis=1), 1e-12)
            view_index = int(np.argmin(np.abs(elevations - _RISE)))
            camera.position = positions[view_index]
            camera.fov = float(
                2.0 * np.arctan(0.5 * views.height / views.intrinsics[view_index, 1, 1])
            )
        camera.look_at = center

    def _enter(self, client: Any) -> None:
        self._people[client.client_id] = _Person(client, self._viewer.lights)

    def _leave(self, client: Any) -> None:
        self._people.pop(client.client_id, None)
        self._viewer.leave(client.client_id)

    def work(self) -> bool:
        """Do one round of work for all users; return whether there was anything to do."""
        has_worked = False
        now = time.perf_counter()
        if now - self._refreshed > _REFRESH:
            self._refreshed = now
            if self._viewer.refresh():
                self._things.renew()
                has_worked = True
        self._things.update()
        for person in tuple(self._people.values()):
            has_worked |= person.show(self._viewer)
        return has_worked

    def serve(self) -> None:
        """Work until Ctrl-C."""
        with suppress(KeyboardInterrupt):
            while True:
                if not self.work():
                    time.sleep(_PAUSE)
        self.stop()

    def stop(self) -> None:
        """Close all connections."""
        self._server.stop()
