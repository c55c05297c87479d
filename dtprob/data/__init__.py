"""The data that people bring: validated types, readers and writers."""

from dtprob.data.kinds import ChannelData, Data, Labels, NetworkLog, PowerData, Table
from dtprob.data.read import read, read_table
from dtprob.data.write import write

__all__ = ["ChannelData", "Data", "Labels", "NetworkLog", "PowerData", "Table", "read", "read_table", "write"]
