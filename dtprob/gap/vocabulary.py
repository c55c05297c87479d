"""Words that a diagnosis and its page share. Light to import: a page is made of a report without the diagnosis."""

from typing import Final, Literal

type Verdict = Literal["NO_GAP", "LISTED", "LISTED_WITH_REMAINDER", "UNLISTED", "UNDETERMINED"]
"""No gap was found; effects of the list cause it, alone or beside something else; no effect of the list does; or the data
cannot tell. Which rule leads to which: `dtprob.gap.decide.decide`."""

UNSEEN: Final = "nothing observed depends on it"
"""What stands for the parameter that absorbs a candidate where there is none."""

READ_TWICE: Final = "was a log read twice?"
"""What the note on readings that are copies of others asks."""
