"""ANTs and elastix apply a displacement field; a process for each, because their copies of ITK do not bear each other.

    python other_programs.py ants|elastix FIXED MOVING FIELD POINTS.npy OUT.npz

Points, shape (n, d), are in the coordinates of the fixed image; OUT has where they are moved, and the moving image in
the frame of the fixed one. Both packages are for Python: pip install antspyx itk-elastix.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np


def ants(fixed, moving, field, points):
    import ants
    import pandas

    fixed, moving = (ants.image_read(path, pixeltype="float") for path in (fixed, moving))
    warped = ants.apply_transforms(fixed, moving, [field], interpolator="linear").numpy().T
    dimension = points.shape[1]
    frame = pandas.DataFrame(points, columns=list("xyz")[:dimension])
    return warped, ants.apply_transforms_to_points(dimension, frame, [field]).to_numpy()[:, :dimension]


def elastix(fixed, moving, field, points):
    import itk

    fixed, moving = (itk.imread(path, itk.F) for path in (fixed, moving))
    parameters = itk.ParameterObject.New()
    parameters.AddParameterMap(_parameters(fixed, field))
    warped = itk.array_from_image(itk.transformix_filter(moving, parameters, log_to_console=False))
    with tempfile.TemporaryDirectory() as folder:
        asked, answer = Path(folder) / "points.txt", Path(folder) / "outputpoints.txt"
        lines = [" ".join(map(repr, map(float, point))) for point in points]
        asked.write_text("\n".join(["point", str(len(points)), *lines, ""]))
        transformix = itk.TransformixFilter[type(moving)].New(moving)
        transformix.SetTransformParameterObject(parameters)
        transformix.SetFixedPointSetFileName(str(asked))
        transformix.SetOutputDirectory(folder)
        transformix.LogToConsoleOff()
        transformix.Update()
        moved = [line.split("OutputPoint = [")[1].split("]")[0].split() for line in answer.read_text().splitlines()]
    return warped, np.array(moved, dtype=float)


def _parameters(fixed, field):
    """What a TransformParameters.txt says that names a field, on the grid of the fixed image."""
    import itk

    dimension = fixed.GetImageDimension()
    grid = {"Size": itk.size(fixed), "Spacing": map(float, fixed.GetSpacing()), "Origin": map(float, fixed.GetOrigin()),
            "Direction": itk.array_from_matrix(fixed.GetDirection()).T.ravel().tolist()}  # fmt: skip
    return {
        "Transform": ["DeformationFieldTransform"], "NumberOfParameters": ["0"], "DeformationFieldFileName": [field],
        "DeformationFieldInterpolationOrder": ["1"], "HowToCombineTransforms": ["Compose"],
        "InitialTransformParameterFileName": ["NoInitialTransform"],
        "FixedImageDimension": [str(dimension)], "MovingImageDimension": [str(dimension)],
        "FixedInternalImagePixelType": ["float"], "MovingInternalImagePixelType": ["float"],
        "Index": ["0"] * dimension, "UseDirectionCosines": ["true"],
        **{name: list(map(str, values)) for name, values in grid.items()},
        "Resampler": ["DefaultResampler"], "ResampleInterpolator": ["FinalLinearInterpolator"],
        "DefaultPixelValue": ["0"], "ResultImageFormat": ["mha"], "ResultImagePixelType": ["float"],
    }  # fmt: skip


if __name__ == "__main__":
    program, fixed, moving, field, points, out = sys.argv[1:]
    warped, moved = {"ants": ants, "elastix": elastix}[program](fixed, moving, field, np.load(points))
    np.savez(out, warped=warped, moved=moved)
