# The environment is .venv at the root; every target brings it up to date first (at once when nothing has changed).
BIN := .venv/bin

.PHONY: setup demo docs test study lint bench lock

setup:
	@sh scripts/setup

demo: setup
	$(BIN)/dtprob demo --out out/demo

# They are plain Markdown; this runs what they tell you to write.
docs: setup
	$(BIN)/python -m pytest tests/unit/test_docs.py tests/unit/test_readme.py

PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0 --durations 60 --durations-min 5

test: setup
	$(PYTEST)

# Long ones that `make test` leaves out.
study: setup
	$(PYTEST) -m study

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# Each against its rival in the same run; the figures go to benchmarks/results.
bench: setup
	for file in benchmarks/bench_*.py; do $(BIN)/python $$file --write; done

# Resolve the dependencies of pyproject.toml anew.
lock: setup
	$(BIN)/python -m uv pip compile pyproject.toml --all-extras --group dev --universal --python-version 3.12 --generate-hashes \
	    --no-emit-index-url --custom-compile-command "make lock" --quiet --output-file requirements.lock
