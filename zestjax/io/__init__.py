"""Files in and out: scenes, weights, checkpoints, pictures and videos. Nothing is ever left half-written.

scenes       `load_scene`: a folder in any supported layout, ready for use
nsff         NSFF's and the NVIDIA Dynamic Scenes' layout, read and written; LLFF's (`llff`) is its special case
nrnerf       NR-NeRF's layout
idr          IDR's layout, as DTU's scans come, read and written
colmap       COLMAP's sparse models with their pictures, read and written
transforms   nerfstudio's and instant-ngp's transforms.json, read and written
nerfies      Nerfies', HyperNeRF's and DyCheck's layout, read and written
table        pictures with a table of cameras, zestjax's own, read and written
n3dv         Neural 3D Video's films, which are refused with what to do
inputs       what a video must be for a view to be predicted from it
weights      trees of arrays in one verified file
checkpoints  those of a training run
pictures     picture files, and pictures of depths and errors
video        moving pictures that a browser plays
"""

from zestjax.io.scenes import load_scene

__all__ = ["load_scene"]
