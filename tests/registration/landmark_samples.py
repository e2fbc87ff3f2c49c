"""Landmark files in the form that each program's documents give, with what they mean in pixels.

The numbers are our own: the files that BigWarp, elastix and ktch publish are not ours to ship.
"""

from __future__ import annotations

from dataclasses import dataclass

MOVING = ((47.5, 103.0), (162.25, 42.90625), (234.375, 119.09375))
FIXED = ((51.09375, 195.28125), (120.0, 49.375), (125.84375, 160.78125))
SHAPE = (256, 240)


@dataclass(frozen=True)
class Sample:
    """File names with contents, the format they are in, and the pairs they hold."""

    name: str
    form: str
    files: tuple[tuple[str, str], ...]
    moving: tuple[tuple[float, float], ...] = MOVING
    fixed: tuple[tuple[float, float], ...] = FIXED
    names: tuple[str, ...] = ("1", "2", "3")


def _markup(system: str, points: str, status: str = '"positionStatus": "defined"') -> str:
    """As Slicer 5 writes it, with what does not matter here left in."""
    controls = ",".join(
        f'{{"id": "{k}", "label": "F-{k}", "description": "", "associatedNodeID": "", "position": [{place}], '
        '"orientation": [-1.0, -0.0, -0.0, -0.0, -1.0, -0.0, 0.0, 0.0, 1.0], "selected": true, "locked": false, '
        f'"visibility": true, {status}}}'
        for k, place in enumerate(points.split(";"), 1)
    )
    return (
        '{"@schema": "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/'
        'markups-schema-v1.0.3.json#", "markups": [{"type": "Fiducial", "coordinateSystem": "' + system + '", '
        '"coordinateUnits": "mm", "locked": false, "labelFormat": "%N-%d", "lastUsedControlPointNumber": 3, '
        '"controlPoints": [' + controls + '], "measurements": [], "display": {"visibility": false, "opacity": 1.0}}]}'
    )


SAMPLES = (
    Sample(
        "plain", "csv",
        (("pairs.csv", "moving_x,moving_y,fixed_x,fixed_y\n47.5,103,51.09375,195.28125\n"
          "162.25,42.90625,120,49.375\n234.375,119.09375,125.84375,160.78125\n"),),
    ),
    Sample(
        "plain, with names, other order, Windows", "csv",
        (("pairs.csv", "\ufeffname,fixed_x,fixed_y,moving_x,moving_y\r\neye,51.09375,195.28125,47.5,103\r\n"
          "\"nose, tip\",120,49.375,162.25,42.90625\r\n\r\nchin,125.84375,160.78125,234.375,119.09375\r\n"),),
        names=("eye", "nose, tip", "chin"),
    ),
    Sample(
        "BigWarp in the plane", "bigwarp",
        (("landmarks.csv", '"Pt-0","true","47.5","103.0","51.09375","195.28125"\n'
          '"Pt-1","true","162.25","42.90625","120.0","49.375"\n"Pt-2","false","1.0","2.0","3.0","4.0"\n'
          '"Pt-3","true","234.375","119.09375","125.84375","160.78125"\n'
          '"Pt-4","false","20.5","21.0","Infinity","Infinity"\n'),),
        names=("Pt-0", "Pt-1", "Pt-3"),
    ),
    Sample(
        "BigWarp in space, one slice", "bigwarp",
        (("landmarks.csv", '"Pt-0","true","47.5","103.0","135.0","51.09375","195.28125","0.0"\n'
          '"Pt-1","true","162.25","42.90625","135.00000000000003","120.0","49.375","0.0"\n'
          '"Pt-2","true","234.375","119.09375","135.0","125.84375","160.78125","0.0"\n'
          '"Pt-3","false","Infinity","Infinity","Infinity","5.0","6.0","0.0"\n'),),
        names=("Pt-0", "Pt-1", "Pt-2"),
    ),
    Sample(
        "elastix, points", "elastix",
        (("moving.pts", "point\n3\n47.5 103\n162.25 42.90625\n234.375 119.09375"),
         ("fixed.pts", "point\n3\n51.09375 195.28125\n120.0 49.375\n125.84375 160.78125\n")),
    ),
    Sample(
        "elastix, indices, without a keyword, in one slice", "elastix",
        (("moving.txt", "index\n2\n12 7 0\n99 141 0\n"), ("fixed.txt", "2\r\n10 9\r\n87 174\r\n")),
        ((12.0, 7.0), (99.0, 141.0)), ((10.0, 9.0), (87.0, 174.0)), ("1", "2"),
    ),
    Sample(
        "tpsDig, scaled, with a curve and a missing landmark", "tps",
        (("specimens.tps", "LM=4\r\n47.50000 152.00000\r\n162.25000 212.09375\r\nNA NA\r\n234.37500 135.90625\r\n"
          "CURVES=1\r\nPOINTS=2\r\n1.0 2.0\r\n3.0 4.0\r\nIMAGE=left.jpg\r\nID=0\r\nSCALE=0.012500\r\n"
          "LM=4\r\n51.09375 59.71875\r\n120.00000 205.62500\r\n9.0 9.0\r\n125.84375 94.21875\r\n"
          "IMAGE=right.jpg\r\nID=1\r\nSCALE=0.013\r\n"),),
        names=("1", "2", "4"),
    ),
    Sample(
        "Slicer, LPS", "slicer",
        (("moving.mrk.json", _markup("LPS", "47.5, 103.0, 0.0;162.25, 42.90625, 0.0;234.375, 119.09375, 0.0")),
         ("fixed.mrk.json", _markup("LPS", "51.09375, 195.28125, 2.0;120.0, 49.375, 2.0;125.84375, 160.78125, 2"))),
        names=("F-1", "F-2", "F-3"),
    ),
    Sample(
        "Slicer, RAS", "slicer",
        (("moving.mrk.json", _markup("RAS", "-47.5, -103.0, 0.0;-162.25, -42.90625, 0.0;-234.375, -119.09375, 0.0")),
         ("fixed.mrk.json", _markup("LPS", "51.09375, 195.28125, 0.0;120.0, 49.375, 0.0;125.84375, 160.78125, 0"))),
        names=("F-1", "F-2", "F-3"),
    ),
    Sample(
        "Slicer fiducials, RAS as Slicer 4 wrote them, and LPS", "fcsv",
        (("moving.fcsv", "# Markups fiducial file version = 4.10\n# CoordinateSystem = 0\n"
          "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
          "vtkMRMLMarkupsFiducialNode_0,-47.5,-103,0,0,0,0,1,1,1,0,F-1,,\n"
          "vtkMRMLMarkupsFiducialNode_1,-162.25,-42.90625,0,0,0,0,1,1,1,0,F-2,,\n"
          "vtkMRMLMarkupsFiducialNode_2,-234.375,-119.09375,0,0,0,0,1,1,1,0,F-3,,\n"),
         ("fixed.fcsv", "# Markups fiducial file version = 5.6\n# CoordinateSystem = LPS\n"
          "# columns = id,x,y,z,ow,ox,oy,oz,vis,sel,lock,label,desc,associatedNodeID\n"
          "2,120,49.375,1,0,0,0,1,1,1,0,F-2,,,2,0\n1,51.09375,195.28125,1,0,0,0,1,1,1,0,F-1,,,2,0\n"
          "3,125.84375,160.78125,1,0,0,0,1,1,1,0,F-3,,,2,0\n")),
        names=("F-1", "F-2", "F-3"),
    ),
)  # fmt: skip


# What must be refused: files, and what the error names.
REFUSED = (
    ((("a.csv", ""),), "a.csv is empty"),
    ((("a.csv", "x0,y0,x1,y1\n1,2,3,4\n"),), "a.csv:1: it begins neither like plain CSV nor BigWarp CSV"),
    ((("a.csv", "moving_x,moving_y,fixed_x\n1,2,3\n"),), "the columns are moving_x,moving_y,fixed_x"),
    ((("a.csv", "moving_x,moving_y,fixed_x,fixed_y\n1,2,3,4\n1,2,3\n"),), "a.csv:3: 3 values for 4 columns"),
    ((("a.csv", "moving_x,moving_y,fixed_x,fixed_y\n1,2,3,nan\n"),), "a.csv:2: fixed_y is 'nan'"),
    ((("a.csv", "moving_x,moving_y,fixed_x,fixed_y\n1,2,3,1_0\n"),), "a.csv:2: fixed_y is '1_0'"),
    ((("a.csv", "moving_x,moving_y,fixed_x,fixed_y\n"),), "a.csv holds no landmarks"),
    ((("a.csv", "moving_x,moving_y,fixed_x,fixed_y\n1,2,3,4\n1,2,5,6\n"),), "moving landmarks 1 and 2 are at"),
    ((("a.csv", '"Pt-0","true","1","2","3"\n'),), "a.csv:1: 'Pt-0,true,1,2,3' is no row of BigWarp"),
    ((("a.csv", '"Pt-0","true","1","2","Infinity","3"\n'),), "a.csv:1: fixed_x is 'Infinity'"),
    ((("a.csv", '"Pt-0","false","1","2","Infinity","Infinity"\n'),), "a.csv: none of its 1 landmarks is active"),
    ((("a.csv", '"P","true","1","2","0","3","4","0"\n"Q","true","5","6","7","8","9","0"\n'),), "landmarks have z"),
    ((("a.pts", "point\n1\n1 2\n"),), "one of a pair of files"),
    ((("fixed.pts", "point\n1\n1 2\n"), ("moving.pts", "point\n1\n1 2\n")), "fixed.pts is given for the moving image"),
    ((("a.pts", "point\n3\n1 2\n"), ("b.pts", "point\n1\n1 2\n")), "a.pts says 3 points and holds 1"),
    ((("a.pts", "point\n1\n1 2\n"), ("b.pts", "point\n2\n1 2\n3 4\n")), "there are 1 moving landmarks but 2 fixed"),
    ((("a.pts", "point\n1\n1 x\n"), ("b.pts", "point\n1\n1 2\n")), "a.pts:3: y is 'x'"),
    ((("a.pts", "point\nmany\n1 2\n"), ("b.pts", "point\n1\n1 2\n")), "a.pts:2: there is no number of points"),
    ((("a.tps", "LM=1\n1 2\n"),), "a.tps holds 1 specimens"),
    ((("a.tps", "LM=2\n1 2\n"),), "a.tps: 2 points are announced in line 1"),
    ((("a.tps", "LM3=1\n1 2 3\n"),), "a.tps:1: landmarks in space"),
    ((("a.tps", "LM=1\n1 2\n3 4\n"),), "a.tps:3: '3 4' stands outside"),
    ((("a.tps", "LM=1\n1 2\nLM=2\n1 2\n3 4\n"),), "1 moving landmarks, but 2 fixed"),
    ((("a.mrk.json", "{"), ("b.mrk.json", "{}")), "a.mrk.json:1: no JSON"),
    ((("a.mrk.json", "{}"), ("b.mrk.json", "{}")), "a.mrk.json holds no point lists"),
    ((("a.json", '{"markups": [{"controlPoints": [{"position": [1, 2]}]}]}'), ("b.json", "{}")), "point 1 is at"),
    ((("a.json", '{"markups": [{"coordinateSystem": "XYZ", "controlPoints": []}]}'), ("b.json", "{}")), "'XYZ'"),
    ((("a.fcsv", "# CoordinateSystem = XYZ\n1,2,3,4\n"), ("b.fcsv", "")), "the coordinate system is 'XYZ'"),
    ((("a.fcsv", "1,2,3\n"), ("b.fcsv", "1,2,3,4\n")), "a.fcsv:1: '1,2,3' is no point of Slicer"),
    ((("a.doc", "1"),), "a.doc: unknown kind of landmark file"),
    ((("a.csv", "moving_x,\0"), ("b.csv", "")), "a.csv is complete, and 2 were given"),
    ((), "there is no landmark file"),
)  # fmt: skip
