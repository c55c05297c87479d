"""Which state of the code made a result."""

import dtprob.edition
from dtprob import __version__
from dtprob.edition import edition


def test_it_changes_with_any_module_and_with_nothing_else(tmp_path, monkeypatch):
    package = tmp_path / "package"
    (package / "inner").mkdir(parents=True)
    file = package / "inner" / "module.py"
    file.write_text("a = 1\n")
    monkeypatch.setattr(dtprob.edition, "__file__", str(package / "edition.py"))

    def now():
        edition.cache_clear()
        return edition()

    before = now()
    assert before.startswith(f"{__version__}+")
    (package / "notes.txt").write_text("no module")
    assert now() == before
    file.write_text("a = 2\n")
    assert now() != before
    edition.cache_clear()
