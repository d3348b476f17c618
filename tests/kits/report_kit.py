"""A measured response as a lab would have it: a small modal model, its noise, its covariance;
and a page as a browser has it."""

from html.parser import HTMLParser

import numpy as np

from samii_rig.report.compare import ModelCurve
from samii_rig.types import Channel, Complex, Finding, Float, FrequencyResponse, Recording, Segment

OUTPUTS = (Channel("theta_2", "rad"), Channel("a_0", "m/s^2"))
INPUTS = (Channel("v_2", "V", "command"),)
MODES = (2.3, 7.4, 21.4)  # Hz, all of 2 % damping


def modal(frequency: Float) -> Complex:
    """(n, 2, 1) an integrator with three modes, and the acceleration that goes with it."""
    s = 2j * np.pi * frequency
    theta = 0.04 / (s * (s / 200 + 1))
    for hz, weight in zip(MODES, (-0.3, 0.2, 0.1), strict=True):
        w = 2 * np.pi * hz
        theta = theta * (1 + weight * s**2 / (s**2 + 0.04 * w * s + w**2))
    acceleration = (
        s**2 * theta * sum(w**2 / (s**2 + 0.04 * w * s + w**2) for w in 2 * np.pi * np.array(MODES))
    )
    return np.stack([theta, acceleration], axis=-1)[:, :, None]


def measured(
    level: float = 1.0,
    *,
    n: int = 500,
    relative: float = 0.02,
    gain: float = 1.0,
    seed: int = 0,
    dof: float = 12.0,
    findings: tuple[Finding, ...] = (),
) -> FrequencyResponse:
    """`modal` times `gain` with circular noise of a known covariance, correlated over outputs."""
    rng = np.random.default_rng(seed)
    f = np.geomspace(0.5, 50.0, n)
    H = gain * modal(f)
    sigma = relative * np.abs(H[:, :, 0])
    mix = np.linalg.cholesky(np.array([[1.0, 0.3], [0.3, 1.0]]))
    unit = (rng.standard_normal((n, 2)) + 1j * rng.standard_normal((n, 2))) / np.sqrt(2)
    error = sigma * (unit @ mix.T)
    covariance = sigma[:, :, None] * sigma[:, None, :] * (mix @ mix.T)
    return FrequencyResponse(
        frequency=f,
        H=H + error[:, :, None],
        covariance=covariance.astype(complex),
        dof=np.full(n, dof),
        coherence=np.full((n, 2), 1 / (1 + relative**2)),
        inputs=INPUTS,
        outputs=OUTPUTS,
        level=level,
        level_unit="V",
        input_rms=np.full((n, 1), level),
        rate_hz=500.0,
        n_averages=3,
        method="burst",
        why="three repeats that start and end at rest",
        findings=findings,
        sources=("run_1",),
    )


def model(gain: float = 1.0) -> ModelCurve:
    """`modal` times `gain` on a grid of its own."""
    f = np.geomspace(0.4, 60.0, 4000)
    return ModelCurve("transfer matrices", f, gain * modal(f), ("theta_2", "a_0"), ("v_2",))


def recorded(n: int = 6000, lost: int = 0) -> Recording:
    """A sweep in three channels at 500 samples/s; `lost` samples missing in the middle."""
    at = np.arange(n + lost)
    keep = (at < n // 2) | (at >= n // 2 + lost)
    t = at / 500.0
    u = np.sin(2 * np.pi * (0.5 + 1.5 * t) * t)
    values = np.stack([u, 0.9 * u, 0.05 * np.roll(u, 7)], axis=1)[keep]
    channels = (Channel("u", "V", "reference"), INPUTS[0], OUTPUTS[0])
    return Recording(
        channels,
        500.0,
        (at[keep] * 2_000_000).astype(np.int64),
        at[keep].astype(np.int64),
        values,
        np.zeros(values.shape, np.uint8),
        segments=(Segment("sweep_1", "burst", 0, n + lost, 1.0, "V"),),
        metadata={"experiment": "swept_sine", "version_numpy": "2", "seed": "7"},
        source="run_1.mcap",
    )


class Page(HTMLParser):
    """What a browser would find in a page: addresses, texts, scripts, ids."""

    def __init__(self, text):
        super().__init__()
        self.addresses, self.ids, self.scripts = [], [], {}
        self.text, self.policy = "", ""
        self._script = None
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.addresses += [v for k, v in attrs if k in ("src", "href", "action", "data", "srcset")]
        self.ids += [found["id"]] if "id" in found else []
        if found.get("http-equiv") == "Content-Security-Policy":
            self.policy = found["content"]
        self._script = tag in ("script", "style") and (found.get("id") or f"{tag}{len(self.ids)}")

    def handle_data(self, data):
        if self._script:
            self.scripts[self._script] = self.scripts.get(self._script, "") + data
        else:
            self.text += data

    def handle_endtag(self, tag):
        if tag in ("script", "style"):
            self._script = None
