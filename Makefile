# One .venv for everything, brought up to date when pyproject.toml changes. `make demo` needs only r2p itself in it.

PYTHON ?= python3
BIN := .venv/bin
RUN := .venv/stamp-run
STAMP := .venv/stamp

.PHONY: demo test lint bench soak docs clean

demo: $(RUN)
	$(BIN)/r2p demo

test: $(STAMP) system
	$(BIN)/pytest --numprocesses auto --maxprocesses 4 --dist loadgroup

lint: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/pyright
	$(BIN)/lint-imports --no-cache

bench: $(STAMP)
	$(BIN)/python -m benchmarks

# Seconds, and messages a second (0: as many as are taken): `make soak SECONDS=600 RATE=2000`.
SECONDS := 3600
RATE := 0

soak: $(STAMP)
	$(BIN)/python -m benchmarks.soak $(SECONDS) --rate $(RATE)

docs: $(STAMP)
	$(BIN)/mkdocs build --strict

clean:
	rm -rf .venv site

$(RUN): pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet --editable '.[all]'
	touch $@

$(STAMP): $(RUN)
	$(BIN)/python -m pip install --quiet --group test --group lint --group docs --group bench
	touch $@

# What the tests use of the system: installed for root, unpacked for others, else they say what they skip.
.PHONY: system
system: $(STAMP)
	@$(BIN)/python -m tests.uml.packages
