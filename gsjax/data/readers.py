"""Registry of dataset formats; `load_dataset` takes ``readers=(*READERS, mine)``."""

from gsjax.data.colmap import COLMAP, NERFSTUDIO_COLMAP
from gsjax.data.llff import LLFF
from gsjax.data.nerf import TRANSFORMS
from gsjax.data.nerfies import NERFIES
from gsjax.data.types import Reader

# In order of precedence. A transforms.json of nerfstudio precedes the COLMAP model that
# it was made from, because its poses were aligned afterwards.
READERS: tuple[Reader, ...] = (COLMAP, TRANSFORMS, NERFSTUDIO_COLMAP, LLFF, NERFIES)
