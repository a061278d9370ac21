"""Files in and out: scenes, weights, checkpoints, pictures and videos. Nothing is ever left half-written.

scenes       `load_scene`: a folder in any supported layout, ready for use
nsff         NSFF's and the NVIDIA Dynamic Scenes' layout, read and written; LLFF's is its special case
nrnerf       NR-NeRF's layout
inputs       what a video must be for a view to be predicted from it
weights      trees of arrays in one verified file
checkpoints  those of a training run
pictures     picture files, and pictures of depths and errors
video        moving pictures that a browser plays
"""

from zestjax.io.scenes import load_scene

__all__ = ["load_scene"]
