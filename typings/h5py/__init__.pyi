# h5py types every access as group, dataset or datatype at once: to the type checker everything in them is Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
