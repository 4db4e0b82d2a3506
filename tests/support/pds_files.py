"""PDS image files with attached labels, written for tests."""

from pathlib import Path


def pds_file(
    path: Path,
    pixels: bytes,
    *,
    sample_type: str = "MSB_INTEGER",
    bits: int = 16,
    size: tuple[int, int] = (3, 4),
    extra: str = "",
    pointer: str = "3",
    padding: bytes = b"",
) -> Path:
    """A PDS image with an attached label of two records of 512 bytes; pixels from record 3."""
    label = (
        "PDS_VERSION_ID = PDS3\r\nRECORD_TYPE = FIXED_LENGTH\r\nRECORD_BYTES = 512\r\n"
        f'^IMAGE = {pointer}\r\nNOTE = "the word END in a text"\r\nOBJECT = IMAGE\r\n'
        f"  LINES = {size[0]}\r\n  LINE_SAMPLES = {size[1]}\r\n  SAMPLE_TYPE = {sample_type}\r\n"
        f"  SAMPLE_BITS = {bits}\r\n{extra}END_OBJECT = IMAGE\r\nEND\r\n"
    )
    path.write_bytes(label.encode().ljust(1024) + padding + pixels)
    return path
