"""A scene as an HTML page, for `gsjax view --html` and `gsjax export`."""

from pathlib import Path

from gsjax.runtime.console import note, say

PAGE_SUFFIXES = (".html", ".htm")
_LARGE_PAGE = 32 * 2**20
_THUMBNAIL = 160  # px, longest side of a photograph in a page


def write_scene_page(
    shown,
    path: Path,
    *,
    title: str,
    with_photos: bool = True,
    parts: int | None = None,
) -> None:
    """Write a page, print its name and size, and report what it leaves out.

    Args:
      shown: a `gsjax.viewer.opening.LoadedContent`.
      path: of the page, replaced if it exists.
      title: of the page.
      with_photos: show the cameras with small photographs.
      parts: as `gsjax.viewer.page.write_page`.

    Raises:
      MissingExtraError: as `write_page`.
      InputError: as `gsjax.viewer.page.write_page`.
    """
    from gsjax.viewer.opening import frusta_with_photos
    from gsjax.viewer.page import write_page
    from gsjax.viewer.splats import MIN_DRAWN_OPACITY

    content = shown.content
    if with_photos and shown.views:
        content.frusta = frusta_with_photos(shown.views, _THUMBNAIL)
    page = write_page(content, path, title=title, parts=parts)
    missing = 0 if page.triangles else page.found - page.drawn
    if missing and content.max_gaussians is None:
        least = max(content.min_opacity, MIN_DRAWN_OPACITY)
        why = f"opacity below {least:g}, or not finite"
        note(f"{missing:,} of {page.found:,} Gaussians left out: {why}")
    of_all = f" of {page.found:,}" if missing else ""
    count = len(content.frusta)
    cameras = f", {count} camera{'s' * (count != 1)}" if count else ""
    size = f"{page.size / 2**20:.2f} MiB"
    drawn, remedy = f"{page.drawn:,}{of_all} Gaussians", "gsjax view --max-gaussians"
    if page.triangles:
        drawn, remedy = f"{page.triangles:,} triangles", "gsjax mesh --triangles"
    moments = f", {page.moments} moments" if page.moments else ""
    say(f"{path}  {drawn}{moments}{cameras}, {size}")
    if page.size > _LARGE_PAGE:
        note(f"a page this large opens slowly; reduce it with {remedy}")
