# make run      set up what is missing, then start the application:  make run ARGS="--trials 1 --headless"
# make test     set up what is missing, then run all tests
# make lint     ruff and pyright
# make screenshots   take the documents' pictures of the pages anew, from real runs (needs chromium)
# make test-interop   do LeRobot's and robomimic's own loaders read our exports? in an environment of its own
# Set-up needs the network once; it is skipped while its inputs are unchanged (stamps in .venv).

VENV := .venv
INPUTS := pyproject.toml constraints.txt scripts/set-up
export PYTHONUNBUFFERED := 1

.PHONY: run test lint screenshots test-interop

run: $(VENV)/.ready-run
	@$(VENV)/bin/far run $(ARGS)

test: $(VENV)/.ready-test
	$(VENV)/bin/python -m pytest $(ARGS)

lint: $(VENV)/.ready-test
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

screenshots: $(VENV)/.ready-test
	@$(VENV)/bin/python docs/screenshots.py $(ARGS)

test-interop: $(VENV)/.ready-run
	@scripts/test-interop

$(VENV)/.ready-run: $(INPUTS)
	@PYTHON="$(PYTHON)" scripts/set-up run
	@touch $@

$(VENV)/.ready-test: $(INPUTS)
	@PYTHON="$(PYTHON)" scripts/set-up test
	@touch $@ $(VENV)/.ready-run
