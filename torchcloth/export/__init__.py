"""An identified cloth in the units and parameters of MuJoCo, Newton and USD."""

from .report import Export, Parameter
from .sheet import Sheet, describe_sheet
from .write import export_cloth, export_fit

__all__ = ["Export", "Parameter", "Sheet", "describe_sheet", "export_cloth", "export_fit"]
