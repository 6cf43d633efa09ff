# `make` or `make help` lists the targets.
SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
export PATH := $(CURDIR)/.venv/bin:$(PATH)

# What `make test` and CI run, cheapest first.
TEST_STEPS := fmt promtool deny clippy unit doc client-test console-test schemathesis compose
PYTHON ?= python3
FUZZ_SECONDS ?= 60
# `make soak SECONDS=60`. The shell has a variable of that name, which is not meant.
SOAK_SECONDS := $(if $(filter command line,$(origin SECONDS)),$(SECONDS),3600)
MODEL ?= dinov2-vits14
# The development profile optimises the kernels and the model, so that one build serves every step
# of `make test`.
DEBUG_BIN := target/debug/placeformer
RELEASE_BIN := target/release/placeformer
IMAGE ?= placeformer:local

.PHONY: help
help: ## Show this list
	@awk -F ':.*## ' '/^## /{printf "\n%s\n", substr($$0, 4)} /^[a-z_-]+:.*## /{printf "  \033[36m%-14s\033[0m %s\n", $$1, $$2}' $(MAKEFILE_LIST)

## Use

.PHONY: demo
demo: ## Serve a demo map, query it, leave a report in demo-report/
	@[ -x $(RELEASE_BIN) ] || echo "Compiling takes seven to ten minutes on two cores, the first time only."
	cargo build --release --locked
	$(RELEASE_BIN) demo --out demo-report

.PHONY: head
head: ## Choose the default projection head again (CAMVID=DIR; models/)
	cargo build --release --locked
	CAMVID="$(CAMVID)" PLACEFORMER=$(RELEASE_BIN) models/make_head.sh

.PHONY: calibration
calibration: ## Fit the default model's calibration again (CAMVID=DIR; models/)
	cargo build --release --locked
	CAMVID="$(CAMVID)" PLACEFORMER=$(RELEASE_BIN) models/make_calibration.sh

.PHONY: bench
bench: ## Measure every stage next to its baselines
	cargo build --release --locked
	$(RELEASE_BIN) bench

.PHONY: container
container: ## Build the container image (IMAGE=placeformer:local)
	docker/build.sh $(IMAGE)

## Test

.PHONY: test
test: ## Everything CI runs, with durations
	@MAKE=$(MAKE) tests/all.sh $(TEST_STEPS)

.PHONY: check
check: fmt clippy ## The quick round: lints, unit tests without the lab's, architecture
	cargo test --locked --workspace --exclude placeformer-lab --lib --test project

.PHONY: fmt
fmt: ## Formatting
	cargo fmt --all --check

.PHONY: clippy
clippy: ## Lints; warnings are errors
	cargo clippy --locked --workspace --all-targets -- -D warnings
	cargo clippy --locked --no-default-features --lib --bins -- -D warnings

.PHONY: deny
deny: .venv/tools ## Licences, bans and sources of dependencies
	cargo fetch --locked
	cargo fetch --locked --manifest-path fuzz/Cargo.toml
	cargo deny --offline --workspace --all-features check bans licenses sources

.PHONY: advisories
advisories: .venv/tools ## Known vulnerabilities (needs the network)
	cargo deny --workspace --all-features check advisories

.PHONY: unit
unit: .venv/tools model ## Unit, property and behaviour tests
	cargo nextest run --locked --workspace --no-fail-fast
	# As a release is built, without crash points: the variable that arms them must be ignored.
	cargo nextest run --locked -p placeformer-store killed

.PHONY: simd
simd: model ## The comparisons with stored outputs, at every level of SIMD
	BIN=$(DEBUG_BIN) tests/simd_levels.sh

.PHONY: doc
doc: ## Examples in the documentation, and its links
	cargo test --locked --workspace --doc
	RUSTDOCFLAGS="-D warnings -A rustdoc::private_intra_doc_links" \
	  cargo doc --locked --workspace --no-deps --document-private-items --quiet

.PHONY: model
ifdef LONDON
model:
	cargo build --release --locked
	LONDON="$(LONDON)" CAMVID="$(CAMVID)" PLACEFORMER=$(RELEASE_BIN) models/make_model.sh
else
model: ## Obtain the model's weights; with LONDON=DIR CAMVID=DIR train on them (models/)
	cargo build --locked
	$(DEBUG_BIN) model pull $(MODEL)
endif

.PHONY: promtool
promtool: ## Prometheus configuration and alert rules
	tests/promtool.sh

.PHONY: schemathesis
schemathesis: model ## Generated requests against a live server
	BIN=$(DEBUG_BIN) tests/schemathesis.sh

.PHONY: client-test
client-test: model ## The Python client: types, wheel, tests and examples against a live server
	BIN=$(DEBUG_BIN) clients/python/check.sh

.PHONY: console-test
console-test: model ## The console in a headless Chromium
	BIN=$(DEBUG_BIN) tests/console/run.sh

.PHONY: compose
compose: model ## The composed system end to end (skips without Docker)
	$(PYTHON) tests/compose/run.py --binary $(DEBUG_BIN)

.PHONY: fuzz
fuzz: .venv/tools ## Each fuzz target for FUZZ_SECONDS (60)
	fuzz/run.sh $(FUZZ_SECONDS)

.PHONY: soak
soak: ## SECONDS (3600) of 1.2x capacity and ten misbehaving clients beside an honest one
	cargo build --release --locked
	$(PYTHON) tests/soak.py --binary $(RELEASE_BIN) --seconds $(SOAK_SECONDS)

# Valgrind knows no AVX-512, so under it the tests stop at AVX2; the sanitizer covers every level.
.PHONY: valgrind
valgrind: ## The kernels' tests under valgrind (needs it installed)
	PROPTEST_CASES=4 valgrind --quiet --error-exitcode=1 \
	  "$$(cargo test --locked --package placeformer-kernels --lib --no-run --message-format json | \
	     $(PYTHON) -c 'import json,sys; print([m["executable"] for m in map(json.loads, sys.stdin) if m.get("executable")][-1])')" \
	  --test-threads 1

# The stable compiler has the sanitizer, but takes its flag only with RUSTC_BOOTSTRAP.
.PHONY: asan
asan: ## The kernels' tests under AddressSanitizer
	RUSTC_BOOTSTRAP=1 RUSTFLAGS=-Zsanitizer=address cargo test --locked --package placeformer-kernels --lib \
	  --target-dir target/asan --target x86_64-unknown-linux-gnu

.PHONY: clean
clean: ## Remove everything made here
	rm -rf target .venv .venv-tests .tools demo-report fuzz/target fuzz/corpus

# Pinned tools in a virtual environment of the project's own.
.venv/tools: tests/tools.txt
	[ -x .venv/bin/pip ] || $(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet --disable-pip-version-check --require-hashes -r tests/tools.txt
	touch $@
