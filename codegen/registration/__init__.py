"""Registration of images by landmarks, with maps that do not fold, exact inverse maps, and certificates.

Points of pictures are (x, y) in pixels, x to the right and y down. The origin is the centre of the top-left pixel.
Arrays of points have shape (n, 2), or (n, 3) for volumes: (x, y, z) in the coordinates of a
`codegen.registration.grid.Grid`. Maps lead from the moving to the fixed image.
"""

from codegen.registration.certificate import Certificate, certify
from codegen.registration.grid import Frame
from codegen.registration.linear import AlignmentChoice, chosen_alignment
from codegen.registration.maps import Registration
from codegen.registration.noise import Outliers, SigmaEstimate, choose_sigma, estimate_sigma, find_outliers
from codegen.registration.pairs import Alignment, LandmarkPairs, align, flipped
from codegen.registration.register import LeaveOneOut, leave_one_out, register
from codegen.registration.warp import WarpReport, displacement_field, warp, warp_reported, write_field

__all__ = [
    "Alignment", "AlignmentChoice", "Certificate", "Frame", "LandmarkPairs", "LeaveOneOut", "Outliers",
    "Registration", "SigmaEstimate", "WarpReport", "align", "certify", "choose_sigma", "chosen_alignment",
    "displacement_field", "estimate_sigma", "find_outliers", "flipped", "leave_one_out", "register", "warp",
    "warp_reported", "write_field",
]  # fmt: skip
