"""The viewer's server: it starts, answers requests, and reports when it cannot."""

import urllib.request
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from support import sphere_views
from test_viewer import LOOK, Recorder, Watch, make_trained

from geosplat_jax.viewer import painter as painting
from geosplat_jax.viewer import server as serving
from geosplat_jax.viewer.painter import Gaussians, Viewer
from geosplat_jax.viewer.server import ViewerError, ViewerServer

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    pytest.importorskip("viser", reason="the viewer needs the package viser (extra `view`)")


class Browser:
    """Stand-in for a client of viser: camera, controls, and a window that receives pictures."""

    client_id = 3

    def __init__(self, views):
        pose = np.linalg.inv(views.world_to_camera[0])
        self.camera = SimpleNamespace(
            position=np.asarray(LOOK.position),
            wxyz=np.asarray(LOOK.rotation),
            look_at=np.zeros(3),
            fov=LOOK.field_of_view,
            up_direction=np.array([0.0, 0.0, 1.0]),
            image_height=400,
            image_width=600,
        )
        self.first = pose
        self.pictures, self.told = [], []
        self.gui, self.scene = self, self

    def add_dropdown(self, label, options, initial_value):
        assert initial_value in options
        return SimpleNamespace(value=initial_value)

    def add_slider(self, label, low, high, step, initial_value, hint=None):
        return SimpleNamespace(value=initial_value)

    def add_markdown(self, content):
        return SimpleNamespace(content=content)

    def set_background_image(self, rgb, *, format, jpeg_quality, depth):
        self.pictures.append(rgb)

    def atomic(self):
        return warnings.catch_warnings()

    def add_notification(self, title, body, auto_close_seconds):
        self.told.append(body)


@pytest.fixture
def views():
    return sphere_views(count=3)


@pytest.fixture
def watch():
    return Watch(make_trained())


@pytest.fixture
def server(watch, views, monkeypatch):
    monkeypatch.setattr(painting, "Renderer", SimpleNamespace(of=lambda trained: Recorder([])))
    splats = Gaussians(
        np.zeros((2, 3)), np.stack([np.eye(3)] * 2), np.ones((2, 3)), np.ones((2, 1))
    )
    monkeypatch.setattr(painting.Painter, "gaussians", lambda self: splats)
    glb = trimesh.creation.icosphere(1).export(file_type="glb")
    monkeypatch.setattr(painting.Painter, "mesh_glb", lambda self: glb)
    monkeypatch.setattr(serving, "_REFRESH", 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with serving.socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        viewer_server = ViewerServer(Viewer(watch, {}), views, port=port)
        yield viewer_server
        viewer_server.stop()


@pytest.mark.filterwarnings("ignore")
def test_a_browser_gets_the_page_and_a_second_server_does_not_get_the_port(server, watch):
    with urllib.request.urlopen(server.url, timeout=20) as answer:
        assert b"<html" in answer.read()
    with pytest.raises(ViewerError, match="cannot be used"):
        ViewerServer(server._viewer, None, port=int(server.url.rsplit(":", 1)[1]))


@pytest.mark.filterwarnings("ignore")
def test_people_get_pictures_and_things_that_they_ask_for(server, watch, views):
    browser = Browser(views)
    assert not server.work()
    server._enter(browser)
    assert server.work()
    assert browser.pictures[0].shape == (128, 192, 3)
    for box in server._things._boxes.values():
        box.value = True
    server._things._cameras.value = True
    server._things._show_photographs()
    assert all(frustum.visible for frustum in server._things._photographs)
    server.work()
    assert set(server._things._sent) == {"mesh", "Gaussians"}
    server._things._boxes["mesh"].value = False
    watch.waiting.append(make_trained(9))
    server.work()
    assert server._people[3]._status.content.startswith("step 9, 192 x 128")
    assert set(server._things._sent) == {"Gaussians"}
    server._things._boxes["Gaussians"].value = False
    server.work()
    assert not server._things._sent
    server._leave(browser)
    assert not server.work()


@pytest.mark.filterwarnings("ignore")
def test_a_click_on_a_photograph_goes_there(server, views):
    browser = Browser(views)
    assert len(server._things._photographs) == 3
    pose = np.linalg.inv(views.world_to_camera[1])
    serving._to_camera(pose, 0.6, "view_1")(SimpleNamespace(client=browser))
    np.testing.assert_allclose(browser.camera.position, pose[:3, 3])
    # The camera keeps its distance to the point it looks at. In OpenCV axes, forward is z and up is
    # -y.
    np.testing.assert_allclose(browser.camera.look_at, 0.0, atol=1e-6)
    np.testing.assert_allclose(browser.camera.up_direction, -pose[:3, 1])
    assert browser.camera.fov == 0.6
    assert browser.told == ["view_1"]
