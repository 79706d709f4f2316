"""From the file of a finger to its jaw file, section and picture."""

from pathlib import Path

from finforce_ifea.errors import JawFileError
from finforce_ifea.jaw.cad.cad_file import read_section
from finforce_ifea.jaw.cad.picture import draw_finger
from finforce_ifea.jaw.cad.proposal import propose, write_jaw
from finforce_ifea.jaw.cad.recognition import Overrides, recognize
from finforce_ifea.jaw.jaw import load_jaw


def make_jaw(
    file: Path,
    output: Path,
    *,
    name: str,
    material: str = "tpu95a",
    unit: str | None = None,
    body: int | None = None,
    width: float | None = None,
    overrides: Overrides,
    picture: Path | None = None,
) -> tuple[list[Path], list[str]]:
    """Read a finger and write the jaw file that describes it; return what was written, and what was found and guessed.

    Args:
        file: the finger, see `read_section`.
        output: the YAML file; its section goes beside it.
        name: of the finger.
        material: a name in `MATERIALS`.
        unit: of the file; None to guess it.
        body: which one of several bodies, from 1.
        width: along y [m]; needed for drawings.
        overrides: what is stated in place of the guesses.
        picture: the PNG file; None for one beside the jaw file.

    Raises:
        JawFileError: The file shows no fin-ray finger; the message says what it shows and what to do.
        MissingDependencyError: An optional reader is not installed.
    """
    raw = read_section(file, unit=unit, body=body)
    width = width or raw.width
    if width is None:
        raise JawFileError(f"{file.name}: a drawing has no width; give it in metres: --width 0.025")
    try:
        finger = recognize(raw.polygon, width, overrides, raw.taper)
    except JawFileError as error:
        raise JawFileError(f"{file.name}: {error}") from error
    proposal = propose(finger, name, material)
    output.parent.mkdir(parents=True, exist_ok=True)
    section = write_jaw(finger, proposal, output, file.name)
    jaw = load_jaw(output)
    picture = picture or output.with_suffix(".png")
    draw_finger(finger, proposal, jaw.build_mesh("coarse"), picture)
    notes = [*raw.notes, *finger.notes]
    spread = f"{1e-6 * jaw.material.young_modulus:.3g} MPa +- {jaw.material.spread:.0%}"
    notes.append(f"{len(proposal.keypoints)} key points, {proposal.candidates[2]} contact candidates")
    notes.append(f"reference point {proposal.reference_note}")
    notes.append(f"{material}: {spread}, until `finforce calibrate` has measured it (--material)")
    return [output, section, picture], notes
