"""How fast and how exact the simulated rig is.

    python benchmarks/bench_sim.py [--rig samii] [--minutes 10] [--repeats 5]

Prints the time to open the rig (all poles counted and found), medians of simulating a
closed-loop run in one piece and in ticks of 20 ms as the run loop asks for it, beside
scipy.signal.dlsim on the same model, and the deviation from the transfer matrices seen through
hold, filters and sampling.
"""

import argparse
import statistics
import time

import numpy as np
from scipy.signal import cont2discrete, dlsim

from samii_rig.devices.protocols import CommandBlock, DeviceLoop
from samii_rig.model.realise import realise
from samii_rig.model.sampled import sampled_response
from samii_rig.rig.load import load_rig
from sim.rig import open_rig

TICK = 0.02  # s


def run(rig, seconds, step, **settings):
    """Wall time of one closed-loop run, and its samples."""
    device = open_rig(rig, settings)
    n = round(seconds * rig.rate_hz)
    device.actuator.configure(DeviceLoop(rig.centring.sensor, rig.centring.kp, 1e9, 1e9, 1e9))
    u = 0.05 * rig.actuator[0].high * np.sin(0.02 * np.arange(n))
    device.actuator.write(CommandBlock(0, u, np.zeros(n)))
    start = time.perf_counter()
    blocks = []
    for _ in range(round(seconds / step)):
        device.clock.sleep(step)
        blocks.append(device.sensor.read())
    return time.perf_counter() - start, blocks


def peer(rig, seconds):
    """Wall time of scipy's loop over the same state space, open loop, without converters."""
    made = realise(rig)
    discrete = cont2discrete(made.state_space(), 1 / rig.rate_hz)
    u = np.sin(0.02 * np.arange(round(seconds * rig.rate_hz)))
    start = time.perf_counter()
    dlsim(discrete, u)
    return time.perf_counter() - start


def accuracy(rig):
    """Largest deviation in magnitude (%) and phase (degrees) to 50 Hz, by sensor."""
    f = np.concatenate([np.geomspace(0.05, 50.0, 400)])
    device = open_rig(rig, {"noise": False})
    made = device.actuator.realisation
    A, B, C, D, _ = cont2discrete(made.state_space(), 1 / rig.rate_hz)
    z = np.exp(2j * np.pi * f / rig.rate_hz)
    inverse = np.linalg.inv(z[:, None, None] * np.eye(len(A)) - A)
    # The device reads before its output changes: a direct term answers one sample later.
    H = np.einsum("oi,fij,jk->fok", C, inverse, B) + D / z[:, None, None]
    ratio = (H / sampled_response(rig, f))[:, :, 0]
    percent = 100 * np.max(np.abs(np.abs(ratio) - 1), axis=0)
    return percent, np.max(np.abs(np.angle(ratio, deg=True)), axis=0)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rig", default="samii")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    rig, _ = load_rig(options.rig)
    seconds = 60 * options.minutes
    start = time.perf_counter()
    device = open_rig(rig, {})
    print(f"open: {time.perf_counter() - start:.2f} s, {device.description}")
    print(f"      {device.metadata['poles_counted']} poles counted and found")
    run(rig, 1.0, 1.0)
    for what, step, settings in (
        ("one piece", seconds, {}),
        ("one piece, disturbance and friction", seconds, {"disturbance_rms": 0.1,
                                                          "coulomb_friction": 0.05}),
        ("ticks of 20 ms", TICK, {}),
    ):  # fmt: skip
        times = [run(rig, seconds, step, **settings)[0] for _ in range(options.repeats)]
        t = statistics.median(times)
        print(f"{options.minutes:g} min, {what}: {t:.2f} s ({seconds / t:.0f} x real time)")
    print(f"scipy.signal.dlsim, one inner step, no loop: {peer(rig, seconds):.2f} s")
    for sensor, percent, degrees in zip(rig.sensor, *accuracy(rig), strict=True):
        print(f"{sensor.name}: to 50 Hz within {percent:.4f} % and {degrees:.4f} degrees")


if __name__ == "__main__":
    main()
