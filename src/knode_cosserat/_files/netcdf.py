"""netCDF files made in memory."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray


def netcdf_in_memory(data: xarray.Dataset, **options: Any) -> io.BytesIO:
    """Return the netCDF-4 file of a dataset; `options` are further ones of `to_netcdf`.

    On a full disk HDF5 crashes the interpreter when it cannot write its last blocks.
    """
    file = io.BytesIO()
    data.to_netcdf(file, engine="h5netcdf", **options)
    return file
