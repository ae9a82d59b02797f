# `make test` builds what the tests need and runs everything: tests, format, lints, docs.

VENV := .venv
BIN := $(VENV)/bin

.PHONY: test format lint unit docs python clean

test: format lint python unit docs

# What reads our recordings as a stranger would, and what checks the Python files. The tests find it in .venv.
$(VENV)/ready: tests/requirements.txt
	python3 -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r tests/requirements.txt
	touch $@

format:
	cargo fmt --all --check

lint:
	cargo clippy --workspace --all-targets -- -D warnings

unit: $(VENV)/ready
	cargo test --workspace

docs:
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps

python: $(VENV)/ready
	$(BIN)/ruff check tests
	$(BIN)/ruff format --check tests

clean:
	cargo clean
	rm -rf $(VENV) out
