"""The report in a real browser: it opens from disk, shows the object, and its sliders move."""

import json
import re
import shutil
import subprocess

import numpy as np
import pytest
import trimesh
from test_page import make_run

from geosplat_jax.io.export import export_mesh_glb
from geosplat_jax.report.page import report_html

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
FLAGS = ("--headless=new", "--no-sandbox", "--disable-gpu-sandbox", "--hide-scrollbars")
# WebGL without a graphics card.
FLAGS = (*FLAGS, "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")

LISTEN = """<script>
window.problems = [];
addEventListener("error", (event) => problems.push(String(event.message)));
addEventListener("unhandledrejection", (event) => problems.push(String(event.reason)));
addEventListener("securitypolicyviolation", (event) => problems.push(event.blockedURI));
const told = console.error;
console.error = (...words) => { problems.push(words.join(" ")); told(...words); };
</script>"""

ASK = """<script>
(async () => {
  const viewer = document.querySelector("model-viewer");
  const wait = (ms) => new Promise((done) => setTimeout(done, ms));
  for (let n = 0; n < 1000 && !viewer.loaded; n++) await wait(100);
  await wait(2000);
  const colors = async () => {
    const image = new Image();
    image.src = URL.createObjectURL(await viewer.toBlob());
    await image.decode();
    const canvas = document.createElement("canvas");
    [canvas.width, canvas.height] = [64, 64];
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0, 64, 64);
    const data = context.getImageData(0, 0, 64, 64).data;
    const seen = new Set();
    for (let n = 0; n < data.length; n += 4) seen.add(data.slice(n, n + 4).join());
    return seen.size;
  };
  const slider = document.querySelector(".stack input");
  const cut = () => getComputedStyle(slider.parentElement.querySelector(".found")).clipPath;
  const before = cut();
  slider.value = 10;
  slider.dispatchEvent(new Event("input"));
  const after = cut();
  const buttons = document.querySelectorAll("button[data-pair]");
  buttons[1].click();
  const shown = [...document.querySelectorAll(".compare")].filter((f) => !f.hidden);
  const answer = {
    loaded: viewer.loaded,
    colors: await colors(),
    before, after,
    pair: shown.map((figure) => figure.dataset.pair),
    charts: document.querySelectorAll(".uplot canvas").length,
    wide: document.documentElement.scrollWidth > innerWidth,
    problems,
  };
  const place = document.createElement("pre");
  place.id = "answer";
  place.textContent = JSON.stringify(answer);
  document.body.append(place);
})();
</script>"""


def browser():
    executable = next(filter(None, map(shutil.which, BROWSERS)), None)
    if executable is None:
        pytest.skip(f"no browser: none of {', '.join(BROWSERS)} is on the PATH")
    return executable


def ball(points):
    """Materials that vary over the surface."""
    shade = 0.5 + points[:, 2]
    albedo = np.stack([shade, 1 - shade, np.full_like(shade, 0.2)], axis=-1)
    return albedo, np.full(len(points), 0.4, np.float32), np.zeros(len(points), np.float32)


def asked(command, page):
    """Return the answer of the page; None where the browser closed it before there was one."""
    dom = subprocess.run(
        [*command, "--virtual-time-budget=60000", "--dump-dom", page.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    ).stdout
    match = re.search(r'<pre id="answer">(.*?)</pre>', dom, re.DOTALL)
    return json.loads(match[1]) if match else None


@pytest.mark.slow
def test_the_page_works_in_a_browser(tmp_path):
    command = browser()
    run = make_run(tmp_path / "run", size=64)
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    glb = run.results / "evaluation" / "mesh.glb"
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    export_mesh_glb(glb, vertices, faces, 2 * vertices, ball, texture_size=64)
    html = report_html([run])
    instrumented_html = html.replace("<head>", f"<head>{LISTEN}", 1).replace(
        "</body>", f"{ASK}</body>"
    )
    page = tmp_path / "asking.html"
    page.write_text(instrumented_html)
    # Virtual time does not wait for rendering, so on a busy machine some attempts come too early.
    for attempt in range(5):
        answer = asked([command, *FLAGS, f"--user-data-dir={tmp_path / str(attempt)}"], page)
        if answer is not None and answer["colors"] > 50:
            break
    assert answer is not None, "the page did not answer"
    assert answer["problems"] == []
    assert answer["loaded"]
    assert answer["colors"] > 50
    assert "50%" in answer["before"]
    assert "10%" in answer["after"]
    assert answer["pair"] == ["albedo, aligned"]
    assert answer["charts"] == 4
    assert not answer["wide"]
