#!/usr/bin/env python3
"""Reference model of the powered leg in Python, independent of the Rust code.

Writes model/tests/model/golden/*.csv, which model/tests/model/golden.rs compares the Rust plant and drives with:

    python3 -m pip install numpy scipy
    python3 examples/exoskeleton/model/reference.py

The model: three-link leg, 80 kg adult, weak person (60 %), device with 40 % of the biological moment and a soft
spring and damper on the reference, 1 ms between command and torque, 1 ms semi-implicit Euler. Angles follow the
recorded trial. Moments and reference are the recorded mean curves, straight lines between 1 % points (the Rust code
has the Fourier series instead; the difference is part of the comparison).

Case `true_phase`: the drives are told the true phase. Case `estimated_phase`: they are told the phase that the
adaptive oscillator finds on the recorded hip angle, without noise, from 3 s earlier on.
"""

import csv
import math
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, filtfilt

HERE = Path(__file__).resolve().parent.parent
JOINTS = ["hip", "knee", "ankle"]
BODY_KG, BODY_M, G = 80.0, 1.78, 9.81
DT = 1e-3
SECONDS = 27.0  # compared stretch, about 20 strides
DECIMATED = 50  # golden rows at 20 Hz

# Winter's table (Dempster): share of body mass, centre and gyration radius; foot from ankle to second metatarsal.
L = np.array([0.245, 0.246]) * BODY_M
FOOT = 0.6 * 0.152 * BODY_M
C = np.array([0.433 * L[0], 0.433 * L[1], 0.5 * FOOT])
M_BODY = np.array([0.100, 0.0465, 0.0145]) * BODY_KG
M_DEVICE = np.array([1.8, 1.5, 1.0])
M = M_BODY + M_DEVICE
I = M_BODY * np.array([0.323 * L[0], 0.302 * L[1], 0.475 * FOOT]) ** 2 + M_DEVICE * 0.1**2
J_ACTUATOR = np.array([0.10, 0.10, 0.06])
T = np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -1.0, 1.0]])

STRENGTH, KH, BH, B_PASSIVE = 0.6, np.array([40.0, 25.0, 25.0]), np.array([3.0, 2.0, 1.5]), 0.5
ASSIST, KP, KD = 0.4, np.array([120.0, 100.0, 80.0]), np.array([6.0, 5.0, 3.0])
TAU_MAX, TAU_RATE = np.array([45.0, 45.0, 60.0]), 2000.0
LOW, HIGH = np.array([-0.61, -0.10, -0.70]), np.array([1.75, 1.75, 0.44])


def dynamics(q, qd):
    """Mass matrix and bias torque in joint coordinates."""
    t = T @ q + np.array([0.0, 0.0, math.pi / 2])
    w2 = (T @ qd) ** 2
    a = np.diag(
        [
            I[0] + M[0] * C[0] ** 2 + (M[1] + M[2]) * L[0] ** 2,
            I[1] + M[1] * C[1] ** 2 + M[2] * L[1] ** 2,
            I[2] + M[2] * C[2] ** 2,
        ]
    )
    k = {(0, 1): (M[1] * C[1] + M[2] * L[1]) * L[0], (0, 2): M[2] * C[2] * L[0], (1, 2): M[2] * C[2] * L[1]}
    h = G * np.array([M[0] * C[0] + (M[1] + M[2]) * L[0], M[1] * C[1] + M[2] * L[1], M[2] * C[2]]) * np.sin(t)
    for (i, j), kij in k.items():
        a[i, j] = a[j, i] = kij * math.cos(t[i] - t[j])
        h[i] += kij * math.sin(t[i] - t[j]) * w2[j]
        h[j] -= kij * math.sin(t[i] - t[j]) * w2[i]
    return T.T @ a @ T + np.diag(J_ACTUATOR), T.T @ h


def table(path):
    """Columns of a CSV file with # comments."""
    with open(path, encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def trial():
    """The recorded trial: splines of the filtered angles, heel strikes from the stance column, raw hip and load."""
    data = table(HERE / "data/gait_trial_moore2015_s15_pre.csv")
    time, b_a = data["time_s"], butter(2, 6.0 / 50.0)
    splines = [CubicSpline(time, filtfilt(*b_a, np.deg2rad(data[f"{j}_r_deg"]))) for j in JOINTS]
    stance = data["stance_r"] > 0.5
    strikes = time[1:][~stance[:-1] & stance[1:]]
    return time, splines, strikes, data["hip_r_deg"], data["grf_v_r"]


def periodic(column):
    """A mean curve at 0, 1, .. 100 % with its last point made equal to its first."""
    return np.append(column[:100], column[0])


def oscillator(hip_deg, load):
    """Adaptive frequency oscillator with heel-strike correction: phase and rate (cycles, cycles/s) each ms."""
    a, p, a0, w = np.array([5.0, 0.0, 0.0, 0.0]), np.zeros(4), hip_deg[0], 2 * math.pi * 0.9
    orders, offset, target, zeroed, last = np.arange(1, 5), 0.0, 0.0, False, -10.0
    phase, rate = np.empty(len(hip_deg)), np.empty(len(hip_deg))
    for i, hip in enumerate(hip_deg):
        error = hip - (a0 + a @ np.sin(p))
        scale = max(np.abs(a).sum(), 2.0)
        p = p + DT * (orders * w + 5.0 * error / scale * np.cos(p))
        w = min(max(w + DT * 2.0 * error / scale * math.cos(p[0]), 2.0), 10.0)
        a0 += DT * 2.0 * error
        a = a + DT * 2.0 * error * np.sin(p)
        if i and load[i - 1] < 0.05 <= load[i] and i * DT - last > 0.6:
            last = i * DT
            miss = (-p[0] - target + math.pi) % (2 * math.pi) - math.pi
            target += miss if not zeroed else 0.5 * miss
            offset, zeroed = (target, True) if not zeroed else (offset, True)
        offset += DT * (target - offset) / 0.25
        phase[i], rate[i] = ((p[0] + offset) / (2 * math.pi)) % 1.0, w / (2 * math.pi)
    return phase, rate


def simulate(tt, splines, phase_true, phase, rate, reference, slope, moment):
    """The leg under person and device: angles after each step (rad) and applied torques (Nm)."""
    at = np.linspace(0.0, 1.0, 101)
    curve = lambda rows, x: np.stack([np.interp(x, at, rows[j]) for j in range(3)], 1)
    qn, qdn, qddn = (np.stack([s(tt, d) for s in splines], 1) for d in range(3))
    bio = BODY_KG * curve(moment, phase_true)
    want, want_d = curve(reference, phase), curve(slope, phase) * rate[:, None]
    forward = ASSIST * BODY_KG * curve(moment, phase)
    q, qd, applied, before = qn[0].copy(), qdn[0].copy(), np.zeros(3), np.zeros(3)
    angles, torques = np.empty_like(qn), np.empty_like(qn)
    for i in range(len(tt)):
        command = np.clip(forward[i] + KP * (want[i] - q) + KD * (want_d[i] - qd), -TAU_MAX, TAU_MAX)
        applied += np.clip(before - applied, -TAU_RATE * DT, TAU_RATE * DT)
        before = command
        mass, bias = dynamics(qn[i], qdn[i])
        contact = mass @ qddn[i] + bias - bio[i]
        person = STRENGTH * bio[i] + KH * (qn[i] - q) + (BH + B_PASSIVE) * (qdn[i] - qd)
        beyond = np.minimum(q - LOW, 0.0) + np.maximum(q - HIGH, 0.0)
        stop = np.where(beyond != 0.0, -400.0 * beyond - 8.0 * qd, 0.0)
        mass, bias = dynamics(q, qd)
        qd = qd + DT * np.linalg.solve(mass, person + applied + contact + stop - bias)
        q = q + DT * qd
        angles[i], torques[i] = q, applied
    return angles, torques


def main():
    """Computes both cases and writes the golden files."""
    time, splines, strikes, hip, load = trial()
    mean = table(HERE / "data/gait_reference.csv")
    reference = [periodic(np.deg2rad(mean[f"{j}_deg"])) for j in JOINTS]
    moment = [periodic(mean[f"{j}_nm_kg"]) for j in JOINTS]
    # Derivative over three cycles, so that its ends are central differences too.
    slope = [np.gradient(np.concatenate([r[:-1], r[:-1], r]), 0.01)[100:201] for r in reference]
    start = strikes[2]
    tt = start + DT * np.arange(round(SECONDS / DT))
    strides = np.interp(tt, strikes, np.arange(len(strikes)))
    true = strides % 1.0
    true_rate = 1.0 / np.diff(strikes)[np.clip(strides.astype(int), 0, len(strikes) - 2)]
    warm = start - 3.0 + DT * np.arange(len(tt) + 3000)
    found, found_rate = (x[3000:] for x in oscillator(np.interp(warm, time, hip), np.interp(warm, time, load)))
    out = HERE / "model/tests/model/golden"
    out.mkdir(exist_ok=True)
    for name, phase, rate in [("true_phase", true, true_rate), ("estimated_phase", found, found_rate)]:
        q, tau = simulate(tt, splines, true, phase, rate, reference, slope, moment)
        with open(out / f"{name}.csv", "w", encoding="utf-8", newline="\n") as file:
            file.write("step,phase," + ",".join(f"{j}_deg" for j in JOINTS) + ",")
            file.write(",".join(f"{j}_nm" for j in JOINTS) + "\n")
            for i in range(0, len(tt), DECIMATED):
                numbers = [phase[i], *np.rad2deg(q[i]), *tau[i]]
                file.write(f"{i}," + ",".join(f"{x:.6f}" for x in numbers) + "\n")
        at = np.linspace(0.0, 1.0, 101)
        want = np.stack([np.interp(phase, at, r) for r in reference], 1)
        error = np.rad2deg(np.sqrt(np.mean((q - want)[3000:] ** 2, 0)))
        print(name, "RMS to reference, deg (after 3 s):", error.round(3))


if __name__ == "__main__":
    main()
