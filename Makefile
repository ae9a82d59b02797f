# `make test` builds what the tests need and runs everything: tests, format, lints, docs.

VENV := .venv
BIN := $(VENV)/bin

.PHONY: test format lint unit docs package python clean

test: format lint unit python docs

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

# The package as `pip` builds it, but in the tests' profile: what cargo has built for them is not built again.
package: $(VENV)/ready
	MATURIN_PEP517_ARGS="--profile dev --strip" $(BIN)/pip install --quiet --disable-pip-version-check "./bindings[test]"

python: package
	$(BIN)/ruff check tests bindings benches
	$(BIN)/ruff format --check tests bindings benches
	$(BIN)/mypy --config-file bindings/pyproject.toml bindings/python/parallax
	cargo build
	$(BIN)/python -m pytest bindings/tests

clean:
	cargo clean
	rm -rf $(VENV) out
