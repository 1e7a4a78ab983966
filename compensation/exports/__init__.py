"""A fitted model as a file for controls and other programs: generic JSON, C, structured text, ONNX, control data; and
the receiver at the control.

An export is one class below `compensation.exports.base.Exporter` in one file and one line in `EXPORTS`.
"""

from data.registry import Registry

EXPORTS = Registry(
    "export",
    {
        "json": "compensation.exports.json_file:JsonExport",
        "c": "compensation.exports.c99:CExport",
        "st": "compensation.exports.structured_text:StructuredTextExport",
        "onnx": "compensation.exports.onnx_graph:OnnxExport",
        "receiver": "compensation.exports.receiver:ReceiverExport",
        "sinumerik": "compensation.exports.sinumerik:SinumerikExport",
    },
)
