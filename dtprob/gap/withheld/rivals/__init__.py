"""Other ways to say why data and model differ, with which a diagnosis is compared on withheld cases."""
