"""Slanted edges integrated over square pixels by the Fourier transform, and their MTF, in NumPy and SciPy."""

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.special import j1


def gaussian(sigma):
    return lambda f: np.exp(-2 * (np.pi * sigma * np.asarray(f)) ** 2)


def diffraction(cutoff):
    def transfer(f):
        s = np.clip(np.abs(f) / cutoff, 0, 1)
        return 2 / np.pi * (np.arccos(s) - s * np.sqrt(1 - s * s))

    return transfer


def defocus(radius):
    def transfer(f):
        z = 2 * np.pi * radius * np.asarray(f) + 1e-12
        return 2 * j1(z) / z * gaussian(0.3)(f)

    return transfer


OPTICS = {  # transfer functions of the frequency in cycles/px
    "motion of 3 px": lambda f: np.sinc(3 * f) * gaussian(0.4)(f),
    "disc of confusion, radius 1.2 px": defocus(1.2),
    "sharpened, overshoot 0.12": lambda f: gaussian(0.6)(f) * (2 - gaussian(1.2)(f)),
    "one-sided blur": lambda f: gaussian(0.5)(f) / (1 + 2j * np.pi * f * 0.6),
    "15 % halo, sigma = 3 px": lambda f: 0.85 * gaussian(0.5)(f) + 0.15 * gaussian(3.0)(f),
    "diffraction, cut-off 1.2 cycles/px": diffraction(1.2),
    "diffraction, cut-off 0.6 cycles/px": diffraction(0.6),
}


def through_pixels(optics, angle):
    """MTF along the normal of an edge, of optics and square pixels."""
    cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    return lambda f: np.abs(optics(np.asarray(f))) * np.sinc(np.asarray(f) * cosine) * np.sinc(np.asarray(f) * sine)


def mtf50_of(mtf):
    grid = np.linspace(0.001, 1, 4000)
    first = np.argmax(mtf(grid) < 0.5)
    return brentq(lambda f: mtf(f) - 0.5, grid[first - 1], grid[first], xtol=1e-14)


def draw_edge_of(optics, angle, size=(120, 80), levels=(0.1, 0.9), offset=(0.3, 0.1)):
    """Edge blurred by optics with any transfer function, by the Fourier integral of the line spread function."""
    step, count = 1 / 64, 2**17
    frequency = np.fft.rfftfreq(count, step)
    cosine, sine = np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))
    spectrum = optics(frequency) * np.sinc(frequency * cosine) * np.sinc(frequency * sine)
    lsf = np.fft.fftshift(np.fft.irfft(spectrum, count)) / step
    position = (np.arange(count) - count // 2) * step
    esf = CubicSpline(position, lsf).antiderivative()
    y, x = (np.arange(n) - (n - 1) / 2 - o for n, o in zip(size, offset[::-1], strict=True))
    bright = esf(x * cosine + y[:, None] * sine) / esf(position[-1])
    return levels[0] + (levels[1] - levels[0]) * bright


def draw_edge(angle, sigma, size=(120, 80), levels=(0.1, 0.9), offset=(0.3, -0.2)):
    """Edge blurred by Gaussian optics, ``angle`` degrees from the vertical; the levels are left and right of it."""
    return draw_edge_of(gaussian(sigma), angle, size, levels, offset)
