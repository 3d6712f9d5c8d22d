"""The process that runs pycolmap, because pycolmap can corrupt memory in a process that also loads
Pillow, torch or OpenCV.

`python -m scene_experts.sfm.worker` reads a request (JSON) from standard input and writes a line of
JSON per step to standard output; COLMAP logs to standard error. Finished work stays in the
database, so a repeated request continues where the previous one stopped. Only `__main__` imports
pycolmap and gives it to the other modules, which import nothing but each other, numpy and the
standard library.
"""
