# `make test` builds what the tests need and runs everything that CI runs: tests, format, lints, docs, licences.

# A failure is no reason not to look at the rest.
MAKEFLAGS += --keep-going

VENV := .venv
BIN := $(VENV)/bin

.PHONY: test format lint unit docs package python deny reference fuzz miri clean

test: format lint unit python docs deny

# What reads our recordings as a stranger would, and what checks the Python files. The tests find it in .venv.
$(VENV)/ready: tests/requirements.txt
	python3 -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -r tests/requirements.txt
	touch $@

format:
	cargo fmt --all --check

lint:
	cargo clippy --workspace --all-targets --features link,foxglove -- -D warnings
	cargo clippy -p parallax-runtime -- -D warnings

unit: $(VENV)/ready
	cargo test --workspace --features link,foxglove --no-fail-fast

# With the features of `lint`, whose checks of our crates' dependencies are then used again.
docs:
	RUSTDOCFLAGS="-D warnings" cargo doc --workspace --no-deps --features link,foxglove,parallax-runtime/conformance

# The package as `pip` builds it, but in the tests' profile and with their features: what cargo has built for them is not built again.
package: $(VENV)/ready
	MATURIN_PEP517_ARGS="--profile dev --strip --features workspace" $(BIN)/pip install --quiet --disable-pip-version-check "./bindings[test]"

python: package
	$(BIN)/ruff check tests bindings benches runtime
	$(BIN)/ruff format --check tests bindings benches runtime
	$(BIN)/mypy --config-file bindings/pyproject.toml bindings/python/parallax
	cargo test --workspace --features link,foxglove --no-run    # the command line that the tests run: after `make unit` it is there
	$(BIN)/python -m pytest bindings/tests

# Its own profile: unoptimised it is built in a third of the time, and checks in three seconds.
DENY := $(VENV)/cargo/bin/cargo-deny
$(DENY): | $(VENV)/ready
	CARGO_PROFILE_DEV_DEBUG=0 CARGO_PROFILE_DEV_OPT_LEVEL=0 \
		cargo install --quiet --debug --locked --root $(VENV)/cargo cargo-deny@0.20.2

# Licences, sources and versions of what we depend on, as deny.toml has them.
deny: $(DENY)
	$(DENY) check licenses bans sources

# docs/cli.md, from what `--help` prints.
reference:
	cargo run --quiet --features link,foxglove -- reference > out.cli.md && mv out.cli.md docs/cli.md

# Garbage for the readers of other people's files: needs a nightly toolchain and `cargo install cargo-fuzz`.
FUZZ_SECONDS := 60
fuzz:
	for reader in expression system csv recording graph; do \
		mkdir -p fuzz/corpus/$$reader; \
		cargo +nightly fuzz run $$reader fuzz/corpus/$$reader fuzz/seeds/$$reader -- \
			-max_total_time=$(FUZZ_SECONDS) -timeout=20 -rss_limit_mb=4096 || exit 1; \
	done

# The `unsafe` that Miri can run: lanes up to AVX2, and the bytes of messages. It knows neither AVX-512 nor memory that processes
# share. Needs a nightly toolchain and `rustup component add --toolchain nightly miri`.
MIRI := MIRIFLAGS="-Zmiri-deterministic-floats -Zmiri-disable-isolation" RUSTFLAGS="-C target-feature=+avx2,+fma" \
	CARGO_TARGET_DIR=target/miri cargo +nightly miri test
miri:
	$(MIRI) -p parallax-model --test lanes
	$(MIRI) -p parallax-runtime --lib data::

clean:
	cargo clean
	rm -rf $(VENV) out
