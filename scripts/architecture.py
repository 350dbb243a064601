"""Layers of the package: the only list. The import test, the drawing and the table of docs/architecture.md use it."""

# From the highest layer to the lowest. A part imports from lower layers only; the parts of one layer do not import each
# other. The text says what a part contains.
LAYERS: tuple[dict[str, str], ...] = (
    {"commands": "the rsvib program: options, progress, output on the terminal"},
    {"video": "process_video.py: videos in two passes; steadying.py; session.py: a running camera"},
    {"report": "results on disk: JSON, CSV, figures (plots.py), HTML page (page.py)"},
    {"config": "TOML files ↔ groups of options"},
    {"stacks": "process.py: the loop over windows; job.py: a window; run_folder.py: how runs are stored and resumed"},
    {"io": "stack_reading.py, stack_writing.py, formats.py (table of formats), one module per format"},
    {
        "evaluation": "image quality, MTF of a slanted edge (slanted_edge.py), Cramér–Rao bound",
        "row_time": "row time of a camera from flickering light or motion",
        "augmentation": "training data for Kornia pipelines",
        "datasets": "drawn scenes and example frames",
    },
    {"tracking": "tracker.py: vibration frame by frame; camera_path.py: path of a hand"},
    {"gyroscope": "recorded motions: files, alignment of clock and axes with frames"},
    {
        "detection": "detect.py: frames → motion, standard deviations, verdict",
        "restoration": "restore.py: frames and motion → frames; exact.py, row_methods.py: methods; judge.py: verdict",
    },
    {"registration": "offsets of bands (register.py, methods.py) and of rows (gradients.py) between frames"},
    {"imaging": "image formation: trajectory, point spread function, blur, optics, noise, simulator"},
    {"frames": "prepare.py: arrays, dtypes, full scale, masks, orientation; entry_points.py: flat options"},
    {"motion": "SensorTiming, Camera, readout times of camera models, Motion, Vibration, FreeMotion, recorded motion"},
    {
        "results": "summary, dictionary, files, figures and reasons of all results",
        "options": "type, bounds, default and description of every option",
    },
    {"checks": "checks of what users give: values, groups of options (values.py), arrays, arguments"},
    {
        "numerics": "splines, Fourier transforms, banded systems, tables of fits",
        "files": "durable writes, bounded reads, paths of outputs, free memory",
    },
    {"execution": "chunks, threads, progress, precision", "text": "numbers, tables and JSON as text"},
)
# Parts of packages, from the lowest layer to the highest; packages that are not listed have one layer.
INNER_LAYERS: dict[str, tuple[set[str], ...]] = {
    "detection": (
        {"measurements"},
        {"tones"},
        {"start", "spectrum"},
        {"rows", "sensitivity", "verdict"},
        {"result", "convergence"},
        {"refinement"},
        {"pipeline"},
        {"other_timing"},
        {"attempts"},
        {"shapes"},
        {"detect"},
    ),
    "evaluation": ({"quality", "edge_fit", "bound"}, {"slanted_edge"}),
    "report": ({"results", "plots"}, {"page"}),
    "restoration": (
        {"frame_motion", "observation", "restoration_verdict"},
        {"frame_pairs", "scene_prior"},
        {"noise", "scene_solver"},
        {"finer_grid", "judge", "priors", "row_methods"},
        {"mosaic_scene"},
        {"exact"},
        {"restore"},
    ),
}


def table_of_packages() -> list[str]:
    """Rows of the table of docs/architecture.md."""
    parts = {name: content for layer in LAYERS for name, content in layer.items()}
    files = {"config", "options", "text"}
    rows = [f"| `{name}{'.py' if name in files else '/'}` | {content} |" for name, content in parts.items()]
    return ["| package | contains |", "|---|---|", *rows]
