"""The augmentation compared with an independent camera, and in containers of Kornia."""

from dataclasses import replace

import kornia.augmentation as kornia_augmentation
import numpy as np
import pytest
import torch
from kornia.geometry.boxes import Boxes
from kornia.geometry.keypoints import Keypoints
from scipy.optimize import brentq
from truth import MARGIN, Motion, crop, decibel, draw_scene, take_frames

from rsvib_torch import RollingShutterVibration, SensorTiming, restore

TIMING = SensorTiming(row_time=40e-6, exposure_rows=30, frame_rows=320)
HEIGHT, WIDTH = 240, 200
MOTION = Motion(amplitude=(3.1, 4.2), frequency=(130.0, 90.0), phase=(0.4, 1.3), image_motion=(60.0, -80.0))


def fixed(motion=MOTION, timing=TIMING, **options):
    """The augmentation with ranges of one value."""
    ranges = {
        name: tuple((value, value) for value in getattr(motion, name))
        for name in ("amplitude", "frequency", "phase", "image_motion")
    }
    return RollingShutterVibration(timing, **ranges, **options)


def mean_displacement(times, motion=MOTION, timing=TIMING):
    """Mean displacement over exposures that begin at ``times``, as a sum of 400 midpoints."""
    nodes = (np.arange(400) + 0.5) / 400 * timing.exposure_time
    return motion.displacement(np.asarray(times, dtype=float)[..., None] + nodes).mean(-2)


def frame_position(point, motion=MOTION, timing=TIMING, start=0.0):
    """Position of a scene point in the frame: the root of ``r = y + Y(t(r))``."""

    def row_displacement(row):
        return mean_displacement(start + row * timing.row_time, motion, timing)

    row = brentq(lambda r: r - point[1] - row_displacement(r)[1], point[1] - 30, point[1] + 30, xtol=1e-10)
    return point[0] + row_displacement(row)[0], row


def moved_points(augmentation, points):
    """Keypoints (B, N, 2) moved as the images of the last call."""
    return augmentation.transform_keypoints(Keypoints(points), augmentation._params, augmentation.flags).to_tensor()


@pytest.fixture(scope="module")
def scene():
    return draw_scene(HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN, seed=11, blur=1.2)


@pytest.fixture(scope="module")
def still(scene):
    return torch.from_numpy(crop(scene))


def test_image_equals_that_of_the_independent_simulator(scene, still):
    truth = take_frames(scene, TIMING, MOTION, 1)[0]
    assert decibel(still, truth) < 25
    assert decibel(fixed()(still[None, None])[0, 0], truth) > 58
    assert decibel(fixed()(still[None, None].float())[0, 0], truth) > 58
    cubic, linear = (decibel(fixed(interpolation=kind)(still[None, None])[0, 0], truth) for kind in ("cubic", "linear"))
    assert linear < cubic - 6


@pytest.mark.parametrize(("scan_axis", "direction"), [("y", "forward"), ("y", "reverse"), ("x", "reverse")])
def test_keypoints_masks_and_boxes_follow_the_image(still, scan_axis, direction):
    """Discs: their centres are keypoints, their pixels the mask, their extents the boxes."""
    centres = torch.tensor([[40.0, 50.0], [150.0, 60.0], [60.0, 180.0], [140.0, 200.0]], dtype=torch.float64)
    radius = 12.0
    y, x = torch.meshgrid(torch.arange(HEIGHT).double(), torch.arange(WIDTH).double(), indexing="ij")
    distances = torch.stack([torch.hypot(x - cx, y - cy) for cx, cy in centres])
    images = torch.sigmoid((radius - distances) / 0.7)[None]
    mask = (distances <= radius).double()[None]
    corners = torch.cat([centres - radius, centres + radius], -1)[None]
    timing = SensorTiming(40e-6, 30, 320, scan_axis=scan_axis, readout_direction=direction)
    chain = kornia_augmentation.AugmentationSequential(
        fixed(timing=timing), data_keys=["input", "mask", "keypoints", "bbox_xyxy"]
    )
    image, moved_mask, points, boxes = chain(images, mask, centres[None], corners + torch.tensor([0, 0, 1.0, 1.0]))

    assert np.abs(points[0].numpy() - centres.numpy()).min(0).max() > 0.3  # the motion is not negligible
    if (scan_axis, direction) == ("y", "forward"):
        expected = np.array([frame_position(centre) for centre in centres.numpy()])
        np.testing.assert_allclose(points[0].numpy(), expected, atol=1e-4)
    weight = image[0] / image[0].sum((-2, -1), keepdim=True)
    centroids = torch.stack([(weight * x).sum((-2, -1)), (weight * y).sum((-2, -1))], -1)
    np.testing.assert_allclose(centroids.numpy(), points[0].numpy(), atol=0.3)  # discs are extended, not points
    differing = ((image[0] > 0.5) != (moved_mask[0] > 0.5)).sum((-2, -1)).double()
    unmoved = ((image[0] > 0.5) != (mask[0] > 0.5)).sum((-2, -1)).double()
    assert (differing < 30).all()  # of 75 pixels on the rim, which blur and rounding displace by half a pixel
    assert (unmoved > 50).all()
    assert set(moved_mask.unique().tolist()) == {0.0, 1.0}
    for index, (left, top, right, bottom) in enumerate((boxes - torch.tensor([0, 0, 1.0, 1.0]))[0].tolist()):
        rows, columns = (moved_mask[0, index] > 0).nonzero().unbind(-1)
        for side, edge in ((left, columns.min()), (top, rows.min()), (-right, -columns.max()), (-bottom, -rows.max())):
            assert side <= float(edge) + 0.6  # no pixel outside the box except by rounding of the mask


@pytest.mark.parametrize("exposure_rows", [1, 30, 60])
def test_points_of_fast_vibrations_and_long_exposures(exposure_rows):
    """Up to two and a half periods in an exposure, where the mean displacement may have the opposite sign."""
    motion = Motion((6.0, 5.0), (640.0, 1060.0), (0.3, -0.9))
    timing = SensorTiming(row_time=40e-6, exposure_rows=exposure_rows, frame_rows=320)
    slow = Motion((3.0, 2.0), (640.0, 1060.0), (0.3, -0.9)) if exposure_rows == 1 else motion
    points = torch.tensor([[20.0, 30.0], [100.0, 31.0], [100.0, 120.5]], dtype=torch.float64)
    augmentation = fixed(slow, timing)
    augmentation(torch.zeros(1, 1, HEIGHT, WIDTH))
    moved = moved_points(augmentation, points[None])[0]
    expected = np.array([frame_position(point, slow, timing) for point in points.numpy()])
    assert np.abs(expected - points.numpy()).max() > 0.2
    np.testing.assert_allclose(moved.numpy(), expected, atol=2e-4)


def test_boxes_are_the_smallest_around_the_distorted_content():
    """The sides of a tall box over several periods are at the largest displacements of its rows."""
    motion = Motion((3.0, 0.0), (400.0, 0.0), (0.3, 0.0))
    boxes = Boxes.from_tensor(torch.tensor([[[50.0, 20.0, 91.0, 221.0]]], dtype=torch.float64), mode="xyxy")
    augmentation = fixed(motion)
    augmentation(torch.zeros(1, 1, HEIGHT, WIDTH))
    moved = augmentation.transform_boxes(boxes, augmentation._params, augmentation.flags)
    x = mean_displacement(np.arange(20, 221) * TIMING.row_time, motion)[:, 0]
    np.testing.assert_allclose(moved.to_tensor("xyxy")[0, 0], [50 + x.min(), 20, 91 + x.max(), 221], atol=1e-3)
    slanted = torch.tensor([[50.0, 60.0], [80.0, 70.0], [70.0, 100.0], [40.0, 90.0]], dtype=torch.float64)
    around = augmentation.transform_boxes(Boxes(slanted[None, None]), augmentation._params, augmentation.flags)
    parts = torch.linspace(0, 1, 500, dtype=torch.float64)[:, None, None]
    sides = (slanted + parts * (slanted.roll(-1, 0) - slanted)).flatten(0, 1)
    taken = np.array([frame_position(point, motion) for point in sides.numpy()])
    (left, top), (right, bottom) = taken.min(0), taken.max(0)
    corners = [[left, top], [right, top], [right, bottom], [left, bottom]]
    np.testing.assert_allclose(around.data[0, 0], corners, atol=5e-3)


def test_frames_of_a_clip_have_one_motion(scene, still):
    """Frames of a clip are consecutive frames of one camera; labels of the clip have the same motion."""
    truth = take_frames(scene, TIMING, MOTION, 3)
    clip = still.expand(1, 3, 1, -1, -1)
    video = kornia_augmentation.VideoSequential(fixed(), same_on_frame=True)
    taken = video(clip)
    for frame in range(3):
        assert decibel(taken[0, frame, 0], truth[frame]) > 58
    assert torch.equal(video(clip, params=video._params), taken)
    point = (80.0, 120.0)
    labelled = kornia_augmentation.AugmentationSequential(
        kornia_augmentation.VideoSequential(fixed()), data_keys=["input", "keypoints"]
    )
    _, points = labelled(clip, torch.tensor(point, dtype=torch.float64).expand(1, 3, 1, 2))
    for frame in range(3):
        expected = frame_position(point, start=frame * TIMING.frame_period)
        np.testing.assert_allclose(points.reshape(3, 2)[frame], expected, atol=1e-4)


def test_clips_of_a_batch_and_free_frames():
    clips = torch.rand(2, 3, 1, 48, 40, dtype=torch.float64)[:, :1].expand(-1, 3, -1, -1, -1)
    augmentation = RollingShutterVibration(TIMING)
    shared = kornia_augmentation.VideoSequential(augmentation)
    taken = shared(clips)
    for clip in range(2):
        alone = {name: value[3 * clip : 3 * clip + 3] for name, value in shared._params[0].data.items() if value.ndim}
        alone |= {"forward_input_shape": torch.tensor([1, 1, 48, 40]), "video_batch_size": torch.tensor(1)}
        torch.testing.assert_close(augmentation(clips[clip], params=alone), taken[clip], rtol=0, atol=1e-3)
    drawn = augmentation.drawn_vibration(shared._params[0].data)
    torch.testing.assert_close(drawn.frequency.float(), shared._params[0].data["frequency"][[0, 3]])  # one per clip
    free = kornia_augmentation.VideoSequential(RollingShutterVibration(TIMING), same_on_frame=False)
    frames = free(clips)
    assert augmentation.drawn_vibration(free._params[0].data).frequency.shape == (6, 2, 1)
    drawn = {name: value for name, value in free._params[0].data.items() if name != "video_batch_size"}
    torch.testing.assert_close(augmentation(clips.flatten(0, 1), params=drawn), frames.flatten(0, 1))


def test_samples_cover_their_ranges():
    ranges = {
        "amplitude": ((0.0, 1.0), (2.0, 3.0)),
        "frequency": ((50.0, 60.0), (50.0, 60.0)),
        "phase": ((-1.0, 1.0), (-1.0, 1.0)),
        "image_motion": ((-10.0, 10.0), (0.0, 5.0)),
    }
    common = {"frequency": (50.0, 60.0), "phase": (-1.0, 1.0), "exposure_rows": (5.0, 50.0), "tones": 2}
    drawn = RollingShutterVibration(TIMING, **ranges | common).forward_parameters((400, 1, 8, 8))
    for name, limits in ranges.items():
        low, high = torch.tensor(limits).unbind(-1)
        values = drawn[name] if drawn[name].ndim == 3 else drawn[name][..., None]
        assert values.shape == (400, 2, 1 if name == "image_motion" else 2)
        least, most = values.amin((0, 2)), values.amax((0, 2))
        assert ((least >= low) & (most <= high) & (most - least > 0.9 * (high - low))).all()
    assert 5 <= drawn["exposure_rows"].min() < 8
    assert 47 < drawn["exposure_rows"].max() <= 50


def test_every_image_has_its_own_motion_and_exposure(still):
    """A batch equals its single images; the blur is that of the sampled exposure."""
    images = still[None, None].expand(3, 2, -1, -1)[..., 20:120, 20:100]
    augmentation = RollingShutterVibration(TIMING, exposure_rows=(2.0, 200.0), tones=2, image_motion=(-50.0, 50.0))
    together = augmentation(images)
    params = augmentation._params
    for index in range(3):
        alone = {
            name: value if value.ndim == 1 and len(value) == 4 else value[index : index + 1]
            for name, value in params.items()
        }
        torch.testing.assert_close(
            augmentation(images[index : index + 1], params=alone)[0], together[index], rtol=0, atol=1e-4
        )
    assert augmentation.drawn_vibration(params).amplitude.shape == (3, 2, 2)
    longer = SensorTiming(row_time=40e-6, exposure_rows=90, frame_rows=320)
    torch.testing.assert_close(fixed(exposure_rows=90)(images), fixed(timing=longer)(images))
    assert (fixed()(images) - fixed(timing=longer)(images)).abs().max() > 0.01
    assert not torch.equal(together[0], together[1])


def test_replay_same_on_batch_keepdim_probability():
    images = torch.rand(4, 3, 40, 32)
    augmentation = RollingShutterVibration(TIMING)
    first = augmentation(images)
    params = augmentation._params
    assert not torch.equal(first, augmentation(images))
    assert torch.equal(first, augmentation(images, params=params))
    torch.manual_seed(3)
    seeded = augmentation(images)
    torch.manual_seed(3)
    assert torch.equal(seeded, augmentation(images))

    same = RollingShutterVibration(TIMING, same_on_batch=True)
    moved = same(images[:1].expand(4, -1, -1, -1))
    assert torch.equal(moved[0], moved[3])
    assert not torch.equal(moved[0], images[0])

    assert RollingShutterVibration(TIMING, keepdim=True)(images[0]).shape == (3, 40, 32)
    assert RollingShutterVibration(TIMING, keepdim=True)(images[0, 0]).shape == (40, 32)
    assert RollingShutterVibration(TIMING)(images[0]).shape == (1, 3, 40, 32)
    assert augmentation(images[:0]).shape == (0, 3, 40, 32)

    half = RollingShutterVibration(TIMING, p=0.5)
    torch.manual_seed(0)
    moved = half(images.repeat(4, 1, 1, 1))
    unchanged = torch.tensor([torch.equal(a, b) for a, b in zip(moved, images.repeat(4, 1, 1, 1), strict=True)])
    assert torch.equal(unchanged, half._params["batch_prob"] < 0.5)
    assert 0 < unchanged.sum() < 16
    assert torch.equal((half.drawn_vibration().amplitude == 0).all((1, 2)), unchanged)
    points = torch.full((16, 1, 2), 15.0)
    shifted = moved_points(half, points)
    assert torch.equal((shifted == 15.0).flatten(1).all(1), unchanged)


def test_types_of_masks(still):
    """Integer labels, a list with one mask per image, and masks without channels have the same motion."""
    images = still[None, None].expand(2, -1, -1, -1).float()
    labels = (torch.arange(HEIGHT)[:, None] // 7 + torch.arange(WIDTH) // 5).remainder(9).expand(2, 1, -1, -1)
    augmentation = RollingShutterVibration(TIMING)
    chain = kornia_augmentation.AugmentationSequential(augmentation, data_keys=["input", "mask"])
    _, moved = chain(images, labels.long())
    params = chain._params
    assert not torch.equal(moved.long(), labels)
    assert set(moved.unique().tolist()) <= set(range(9))
    _, listed = chain(images, list(labels.float()), params=params)
    _, flat = chain(images, labels[:, 0].float(), params=params)
    for index in range(2):
        assert torch.equal(listed[index].reshape(HEIGHT, WIDTH), moved[index, 0].float())
        assert torch.equal(flat[index].reshape(HEIGHT, WIDTH), moved[index, 0].float())


def test_dtype_gradient_and_autocast():
    images = torch.rand(2, 1, 40, 32, dtype=torch.float64, requires_grad=True)
    augmentation = RollingShutterVibration(TIMING)
    moved = augmentation(images)
    moved.square().sum().backward()
    # the operator is linear: <A x, A x> has the gradient 2 A^T A x, whose product with x is 2 |A x|^2
    torch.testing.assert_close((images.grad * images).sum(), 2 * moved.square().sum())
    params = augmentation._params
    for dtype, tolerance in ((torch.float32, 2e-6), (torch.float16, 1e-3), (torch.bfloat16, 8e-3)):
        found = augmentation(images.detach().to(dtype), params=params)
        assert found.dtype == dtype
        torch.testing.assert_close(
            found.double(), augmentation(images.detach().to(dtype).double(), params=params), rtol=0, atol=tolerance
        )
    plain = augmentation(images.detach().float(), params=params)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(augmentation(images.detach().float(), params=params), plain)


def test_an_augmentation_has_no_inverse():
    augmentation, images = RollingShutterVibration(TIMING), torch.rand(1, 1, 40, 32)
    for data_key, value in (
        ("input", images),
        ("keypoints", torch.ones(1, 1, 2)),
        ("bbox_xyxy", torch.tensor([[[1.0, 1, 5, 5]]])),
    ):
        chain = kornia_augmentation.AugmentationSequential(augmentation, data_keys=["input", data_key])
        outputs = chain(images, value)
        with pytest.raises(NotImplementedError, match="restore\\(frames, timing, vibration\\)"):
            chain.inverse(outputs[1], data_keys=[data_key])


def test_images_are_recorded_at_the_start_of_frame_0():
    scene = torch.from_numpy(draw_scene(HEIGHT, WIDTH, 5)).float()
    late = replace(TIMING, frame_start_times=(0.0043, 0.03))
    augmentation = fixed(Motion(MOTION.amplitude, MOTION.frequency, MOTION.phase), late)
    frame = augmentation(scene[None, None])[0]
    restored = restore(frame, late, augmentation.drawn_vibration()[0], check=False)
    raw, after = ((image - scene)[0, 20:-20, 20:-20].square().mean().sqrt() for image in (frame, restored))
    assert after < 0.1 * raw
