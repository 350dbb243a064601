"""Processing of stacks of any length: ``process_stack``.

One loop: the frames of the source are read in windows; the motion of each window is detected, its frames are restored
and the result is judged (``StackJob.compute``, in threads); finished windows are stored in a folder (``RunFolder``)
and become the output and its manifest (``FileRun``) when all of them are there.
"""

from contextlib import closing
from pathlib import Path

import torch

from rsvib_torch.checks.arguments import PathLike
from rsvib_torch.execution.parallel import in_threads
from rsvib_torch.frames.entry_points import file_options
from rsvib_torch.io.stack_writing import check_info_target, metadata_not_kept, stack_files, write_frames
from rsvib_torch.motion.detected_vibration import DetectedVibration
from rsvib_torch.motion.timing import SensorTiming
from rsvib_torch.options import ProcessStackOptions, StackOptions
from rsvib_torch.stacks.job import plan_job, read_windows
from rsvib_torch.stacks.manifest import manifest_header
from rsvib_torch.stacks.memory import share_one_heap
from rsvib_torch.stacks.run_folder import FileRun, StackReport, check_space

_MAX_INITIAL_FAILURES = 8  # windows; a run stops if detection fails in all of them, or in all of a shorter stack


@file_options(ProcessStackOptions)
def process_stack(source: PathLike, sink: PathLike, timing: SensorTiming, options: ProcessStackOptions) -> StackReport:
    """Restore a stack of any length from file to file.

    The stack is cut into windows of at most ``window`` frames that share one frame with their neighbours. Each is
    processed as a separate stack, with the time origin at its first frame. Results do not depend on memory and workers,
    and memory does not grow with the number of frames. The output gets its name when it is complete; until then it is
    stored in the folder ``.NAME.rsvib`` beside it, from which an interrupted run can be resumed.

    Frames that cannot be read or used (constant, infinite, beyond full scale) are listed in the manifest; the other
    frames of their window are restored without them. A window in which the detection fails is written unchanged.

    Args:
        source: The stack, as in ``read_stack``.
        sink: The stack to write; metadata are kept as far as the format supports them (``metadata_not_kept``).
        timing: The sensor. If it has no frame start times and the file states them, those of the file are used.
        options: Options.

    Returns:
        Summary of the run.

    Raises:
        FileExistsError: If there is an interrupted run and ``resume`` is False.
        OSError: If a file cannot be read or written; the run can then be resumed.
        ValueError: If a window does not fit into the memory, detection fails in all first windows, an output is,
            contains or lies in the input, or input, settings or versions differ from those of the run to resume.

    Example:
        >>> import tempfile
        >>> import rsvib_torch as rsv
        >>> from rsvib_torch.datasets import example_frames
        >>> frames, timing, _ = example_frames(num_frames=4)
        >>> folder = tempfile.mkdtemp()
        >>> rsv.write_stack(f"{folder}/frames.npy", frames)
        >>> options = {"window": 3, "detection": {"tones": 1}, "restoration": {"method": "dewarp"}}
        >>> report = rsv.process_stack(f"{folder}/frames.npy", f"{folder}/restored.npy", timing, **options)
        >>> report.windows, report.restored, report.bad_frames
        (2, 2, 0)
        >>> rsv.read_stack(f"{folder}/restored.npy").shape == frames.shape
        True
    """
    # 1. What is computed, and what is written.
    sink = Path(sink)
    job, windows, at_once = plan_job(source, timing, options)
    out = job.info.with_frames(len(windows) if job.is_joined else job.info.shape[0])
    out = job.content(out.restored_as(job.chosen.scale, job.chosen.mosaic), timing)
    form = check_info_target(sink, out, parent_exists=False)
    run = FileRun(sink, options, manifest_header(job, sink.name), stack_files(source))
    # 2. A complete output is not computed again.
    finished = run.finished()
    if finished is not None:
        return finished
    with run.folder() as folder:
        records = folder.records()
        missing, resumed = [window for window in windows if window.index not in folder], len(records)
        # the finished windows and the output are on the disk together, until the output is complete
        remaining, total = sum(window.kept for window in missing), job.info.shape[0]
        stored = len(missing) if job.is_joined else remaining
        stored += out.shape[0] if form.uncompressed else 0
        check_space(sink, stored * out.frame_bytes)
        # 3. The windows that are not in the folder: read, detected, restored, judged, stored.
        detection: DetectedVibration | None = None
        report = options.progress or (lambda done, total: None)
        report(total - remaining, total)
        share_one_heap()
        # Sums of floats depend on the number of threads: results must not depend on how many windows are computed.
        threads = torch.get_num_threads() if all(window.alone for window in missing) else 1
        computed = in_threads(job.compute, read_windows(job, missing), at_once=at_once, threads=threads)
        with closing(computed) as results:
            for window, (record, frames, of_first) in zip(missing, results, strict=True):
                records.append(record)
                detection = detection or of_first
                if len(records) >= min(_MAX_INITIAL_FAILURES, len(windows)) and all(one.error for one in records):
                    folder.remove()
                    raise ValueError(records[0].error)
                folder.add(record, frames)
                remaining -= window.kept
                report(total - remaining, total)
        # 4. The output from the windows in the folder, and the manifest.
        with run.writing(folder, not_kept=metadata_not_kept(job.info, sink, out.shape)) as manifest:
            write_frames(form, sink, out, folder.frames())
    return run.report(manifest, resumed, detection)


def first_detection(source: PathLike, timing: SensorTiming, options: StackOptions) -> DetectedVibration | None:
    """The detection in the first window of a stack with its offset curve, as ``StackReport.detection`` has it."""
    job, windows, _ = plan_job(source, timing, options)
    with closing(read_windows(job, windows[:1])) as first:
        return job.compute(*next(first))[2]
