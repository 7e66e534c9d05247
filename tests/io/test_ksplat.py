"""`.ksplat` files of every level and degree, and of several sections."""

import numpy as np
import pytest
from captures import warned
from ksplat_files import BLOCK, C0, RANGE, SH_ENDS, ksplat_fields, ksplat_file

import gsjax

pytestmark = pytest.mark.usefixtures("float32")
# Half a step of a mean and of a harmonic, by level, and the precision of scales.
STEPS = (
    (1e-6, 1e-6, 1e-6),
    (BLOCK / 2 / RANGE / 2, 2e-3, 6e-4),
    (BLOCK / 2 / RANGE / 2, (SH_ENDS[1] - SH_ENDS[0]) / 255 / 2, 6e-4),
)


@pytest.mark.parametrize("level", range(3))
@pytest.mark.parametrize("degree", range(3))
def test_all_values_are_read(tmp_path, level, degree):
    fields, path = ksplat_fields(7, degree), tmp_path / "a.KSPLAT"
    path.write_bytes(ksplat_file(level, fields))
    found = gsjax.load(path).params
    mean, harmonic, scale = STEPS[level]
    np.testing.assert_allclose(found.means, fields["means"], atol=mean + 1e-6)
    np.testing.assert_allclose(np.exp(found.log_scales), fields["scales"], rtol=scale)
    np.testing.assert_allclose(found.quats, fields["quats"], rtol=scale, atol=1e-6)
    colors = np.asarray(0.5 + C0 * found.sh[:, 0])
    opacities = 1 / (1 + np.exp(-np.asarray(found.logit_opacities)))
    rgba = np.column_stack([colors, opacities])
    np.testing.assert_allclose(rgba, fields["rgba"], atol=0.2501 / 255)
    rest = np.asarray(found.sh[:, 1:])
    np.testing.assert_allclose(rest, fields["sh"][:, 1:], atol=harmonic + 1e-6)


def test_sections_follow_each_other(tmp_path):
    """The degree is the highest; bytes after the last one are ignored."""
    parts = [ksplat_fields(count, degree, count) for count, degree in ((3, 1), (4, 0))]
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat_file(0, *parts) + b"more")
    message = "4 bytes after the last section"
    found = warned(message, gsjax.load, path).params
    means = np.concatenate([part["means"] for part in parts])
    np.testing.assert_allclose(found.means, means, rtol=1e-6)
    assert found.sh.shape == (7, 4, 3)
    assert np.all(np.asarray(found.sh)[3:, 1:] == 0)
    assert np.any(np.asarray(found.sh)[:3, 1:] != 0)


def test_a_scale_of_zero_is_thin(tmp_path):
    fields, path = ksplat_fields(3), tmp_path / "a.ksplat"
    fields["scales"][1, 2] = 0
    path.write_bytes(ksplat_file(1, fields))
    assert float(gsjax.load(path).params.log_scales[1, 2]) == -80
