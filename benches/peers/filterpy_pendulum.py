"""The pendulum's unscented filter in filterpy: a prediction with its update, and three predictions ahead.

The same model, step and numbers as in `nodes/benches/estimator.rs`, as a user of filterpy writes them.
"""

import math
import time

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

INERTIA, MASS, LENGTH, DAMPING, MOTOR, RESISTANCE = 1.6e-4, 0.0509, 0.0415, 1.43e-5, 0.0333, 7.73
STEP, DISTURBANCE, NOISE = 0.01, 2.0, 1.5e-3


def derivative(x, voltage):
    """The rates of angle and speed."""
    angle, speed = x
    torque = MOTOR * (voltage - MOTOR * speed) / RESISTANCE + MASS * 9.81 * LENGTH * math.sin(angle) - DAMPING * speed
    return np.array([speed, torque / INERTIA])


def advance(x, dt, voltage=0.0):
    """One step of the classical Runge-Kutta method."""
    a = derivative(x, voltage)
    b = derivative(x + 0.5 * dt * a, voltage)
    c = derivative(x + 0.5 * dt * b, voltage)
    d = derivative(x + dt * c, voltage)
    return x + dt / 6 * (a + 2 * b + 2 * c + d)


def measure(predictions, steps=500):
    """Seconds for each of `steps` steps."""
    points = MerweScaledSigmaPoints(2, alpha=1.0, beta=0.0, kappa=1.0)
    ukf = UnscentedKalmanFilter(2, 1, STEP, lambda x: x[:1], advance, points)
    ukf.x = np.array([3.0, 0.5])
    ukf.P = np.diag([0.01, 1.0])
    ukf.R = np.array([[NOISE**2]])
    ukf.Q = DISTURBANCE**2 * np.array([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]])
    taken = []
    for step in range(steps):
        voltage = 1.0 if step % 2 == 0 else -1.0
        reading = ukf.x[:1] + 1e-4
        start = time.perf_counter()
        ukf.predict(voltage=voltage)
        ukf.update(reading)
        kept = ukf.x.copy(), ukf.P.copy()
        for _ in range(predictions):
            ukf.predict(voltage=voltage)
        ukf.x, ukf.P = kept
        taken.append(time.perf_counter() - start)
    return np.array(taken) * 1e6


if __name__ == "__main__":
    for predictions in (0, 3):
        p50, p5, p99 = np.percentile(measure(predictions), [50, 5, 99])
        print(f"prediction, update and {predictions} predictions: p50 {p50:.0f} us, p5 {p5:.0f} us, p99 {p99:.0f} us")
