use super::*;
use crate::http::{ApiKey, Role};

fn from_toml(text: &str) -> Result<Config, ConfigError> {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("placeformer.toml");
    std::fs::write(&path, text).unwrap();
    let loaded = Config::load(Some(&path), &Overrides::default())?;
    let from = loaded.loaded_from.as_ref().unwrap();
    assert_eq!(from.file.as_deref(), Some(path.as_path()));
    Ok(Config {
        loaded_from: None,
        ..loaded
    })
}

fn from_variable(name: &str, value: &str) -> Result<Config, ConfigError> {
    let variables = [(name.into(), value.into())];
    Config::load_with_environment(None, variables.into_iter(), &Overrides::default())
}

#[test]
fn the_file_changes_what_it_names_and_flags_win() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("placeformer.toml");
    std::fs::write(&path, "[http]\nlisten = \"[::1]:1\"\nmax_page = 7\n").unwrap();
    let model = ModelOverrides {
        weights: Some("own.safetensors".into()),
        difference: Some("difference.safetensors".into()),
        head: Some(HeadChoice::File("head.safetensors".into())),
        ..Default::default()
    };
    let overrides = Overrides {
        listen: Some("127.0.0.1:0".into()),
        model,
        ..Default::default()
    };
    let config = Config::load(Some(&path), &overrides).unwrap();
    assert_eq!(config.extract.weights, Some("own.safetensors".into()));
    assert_eq!(
        config.extract.difference,
        Some("difference.safetensors".into())
    );
    assert_eq!(
        config.extract.head,
        HeadChoice::File("head.safetensors".into())
    );
    assert_eq!(
        (config.http.listen.as_str(), config.http.max_page),
        ("127.0.0.1:0", 7)
    );
    assert_eq!(config.pipeline, PipelineConfig::default());
}

#[test]
fn unknown_keys_and_wrong_types_are_named() {
    for (text, named) in [
        ("[http]\nlisten_on = \"x\"", "listen_on"),
        ("[web]\nlisten = \"x\"", "web"),
        ("[http]\nmax_page = \"many\"", "max_page"),
        ("[pipeline]\nqueue_capacity = 0", "queue_capacity"),
        ("[pipeline]\nstore_reads = 7", "store_reads"),
        ("[store]\nreaders = 5", "store_reads"),
        ("[log]\nfilter = \"placeformer=loud\"", "loud"),
        ("[rerank]\nscales = []", "rerank.scales"),
        (
            "[rerank]\nscales = [\"1+2\", \"1\", \"1+2\"]",
            "1+2 is given twice",
        ),
        (
            "[rerank]\ntolerance_patches = 0.0",
            "rerank.tolerance_patches",
        ),
        (
            "[rerank]\ntolerance_patches = nan",
            "rerank.tolerance_patches",
        ),
        (
            "[rerank]\ntolerance_patches = inf",
            "rerank.tolerance_patches",
        ),
        ("[rerank]\nmax_iterations = 0", "rerank.max_iterations"),
        (
            "[rerank]\nmax_iterations = 1000001",
            "rerank.max_iterations",
        ),
        ("[rerank]\nconfidence = 1.0", "rerank.confidence"),
        ("[rerank]\nconfidence = 0.0", "rerank.confidence"),
        ("[store]\npage_bytes = 5000", "store.page_bytes"),
        ("[store]\npage_bytes = 2048", "store.page_bytes"),
        ("[store]\npage_bytes = 131072", "store.page_bytes"),
        ("[store]\nreaders = 0", "store.readers"),
        ("[store]\nqueue = 0", "store.queue"),
        ("[store]\ncache_kib = 0", "store.cache_kib"),
        ("[image]\nmax_bytes = 0", "image.max_bytes"),
        ("[image]\nmax_side = 0", "image.max_side"),
        ("[image]\nmax_pixels = 0", "image.max_pixels"),
        ("[image]\nmax_jpeg_samples = 0", "image.max_jpeg_samples"),
        ("[extract]\nexit_block = 12", "extract.exit_block"),
        ("[extract]\nhead = \"none\"", "extract.head"),
        (
            "[[auth.keys]]\nname = \"a\"\nsha256 = \"12\"\nrole = \"read\"",
            "sha256",
        ),
    ] {
        let error = from_toml(text).unwrap_err().to_string();
        assert!(error.contains(named), "{error:?} does not name {named:?}");
    }
}

#[test]
fn the_printed_configuration_reads_back_the_same() {
    let mut config = Config::default();
    config.http.max_page = 33;
    config.auth.keys.push(ApiKey {
        name: "fleet".into(),
        sha256: "ab".repeat(32).into(),
        role: Role::Read,
        requests_per_second: None,
        maps: None,
    });
    config.log.filter = "placeformer=debug".into();
    config.extract.weights = Some("own \"quoted\".safetensors".into());
    // All the settings that are unset by default.
    let effective = config.extract.effective().unwrap();
    config.extract = ExtractConfig {
        heads: Some(6),
        difference: Some("difference.safetensors".into()),
        ..effective
    };
    let printed = config.to_annotated_toml().unwrap();
    assert_eq!(from_toml(&printed).unwrap(), config);
    assert!(!printed.contains("\n# heads ="), "{printed}");
    assert!(printed.contains("\nheads = 6\n"), "{printed}");
    assert_eq!(
        from_toml(&Config::default().to_annotated_toml().unwrap()).unwrap(),
        Config::default()
    );
}

#[test]
fn every_setting_is_printed_under_its_explanation() {
    let config = Config::default();
    let values = toml::Table::try_from(&config).unwrap();
    let sections = manual::sections::<Config>();
    for (name, keys) in &values {
        let section = sections.iter().find(|section| section.name == *name);
        let section = section.unwrap_or_else(|| panic!("section {name} is not in the manual"));
        for (key, _) in keys.as_table().unwrap() {
            assert!(
                section.settings.iter().any(|setting| setting.name == *key),
                "{name}.{key} is not in the manual"
            );
        }
    }

    let printed = config.to_annotated_toml().unwrap();
    for section in &sections {
        assert!(!section.explanation.is_empty(), "[{}]", section.name);
        assert!(!section.settings.is_empty(), "[{}]", section.name);
        for setting in &section.settings {
            let name = format!("{}.{}", section.name, setting.name);
            assert!(!setting.explanation.is_empty(), "{name} is unexplained");
            assert!(
                !setting.explanation.contains("[`"),
                "the explanation of {name} has a link that only rustdoc resolves"
            );
            let comment: String = setting
                .explanation
                .lines()
                .map(|line| format!("# {line}\n"))
                .collect();
            let explained = [
                format!("{comment}{} = ", setting.name),
                format!("{comment}# {} =\n", setting.name),
            ];
            assert!(
                explained.iter().any(|lines| printed.contains(lines)),
                "{name} is not printed under its explanation"
            );
        }
    }
}

#[test]
fn every_setting_of_the_manual_is_known() {
    // No setting takes this table, so that the error is about the value where the key is known, and
    // about the key where it is not.
    let refusal = |section: &str, key: &str| {
        let text = format!("[{section}]\n{key} = {{ nonsense = 1 }}");
        from_toml(&text).unwrap_err().to_string()
    };
    let unknown = refusal("http", "listen_on");
    assert!(
        unknown.contains("unknown field: found `listen_on`"),
        "{unknown}"
    );
    for section in manual::sections::<Config>() {
        for setting in section.settings {
            let error = refusal(&section.name, &setting.name);
            let key = format!("for key \"{}.{}", section.name, setting.name);
            let unknown = format!("unknown field: found `{}`", setting.name);
            assert!(
                error.contains(&key) && !error.contains(&unknown),
                "{}.{} is explained but not known: {error}",
                section.name,
                setting.name
            );
        }
    }
}

#[test]
fn the_manual_says_what_the_code_does_with_a_setting() {
    let printed = Config::default().to_annotated_toml().unwrap();
    // Where a sentence is wrapped depends on its length, which is not what this test is about.
    let unwrapped = printed.replace("\n# ", " ");
    for said in [
        "Never more than a quarter of the reserve",
        "at most a quarter of what the disk has left",
        "printf %s KEY | sha256sum",
        "  role: \"read\" (queries, matches, listings and metrics), \"write\" (everything), or",
        "  maps: The maps that it is limited to, by name or by the beginning of names ([\"city-*\"])",
        "0 means 85% of what the process may use",
    ] {
        assert!(
            unwrapped.contains(said),
            "{said:?} is missing in\n{printed}"
        );
    }
    // A setting that has no value is shown as a comment.
    assert!(printed.contains("\n# weights ="), "{printed}");
}

#[test]
fn variables_with_one_underscore_too_few_are_refused() {
    let error = from_variable("PLACEFORMER_HTTP_LISTEN", "x").unwrap_err();
    let error = error.to_string();
    assert!(error.contains("PLACEFORMER_HTTP__LISTEN"), "{error}");
    assert_eq!(
        from_variable("PLACEFORMER_HTTP__LISTEN", "x")
            .unwrap()
            .http
            .listen,
        "x"
    );
    for of_others in ["PLACEFORMER_CACHE", "HTTP_LISTEN", "HTTP__LISTEN"] {
        let config = from_variable(of_others, "x").unwrap();
        assert_eq!(config, Config::default(), "{of_others}");
    }
}

#[test]
fn variables_win_over_the_file() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("placeformer.toml");
    std::fs::write(&path, "[http]\nmax_page = 7\nmax_connections = 8\n").unwrap();
    let variables = [("PLACEFORMER_HTTP__MAX_PAGE".into(), "9".into())];
    let overrides = Overrides::default();
    let config =
        Config::load_with_environment(Some(&path), variables.into_iter(), &overrides).unwrap();
    assert_eq!(config.http.max_page, 9);
    assert_eq!(config.http.max_connections, 8);
}

#[test]
fn errors_in_a_file_name_the_file_and_the_key() {
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("own settings.toml");
    for (text, key) in [
        ("[http]\nlisten_on = \"x\"", "listen_on"),
        ("[web]\nlisten = \"x\"", "web"),
        ("[http]\nmax_page = \"many\"", "http.max_page"),
        ("[store]\nqueue = -1", "store.queue"),
        ("[http]\nmax_page = 0", "http.max_page is set by"),
        ("[rerank]\nconfidence = 1.0", "rerank.confidence is set by"),
        ("[extract]\nexit_block = 12", "extract.exit_block is set by"),
        ("[extract]\nhead = \"none\"", "extract.head is set by"),
        (
            "[log]\nfilter = \"placeformer=loud\"",
            "log.filter is set by",
        ),
        ("[store]\nreaders = 5", "store.readers is set by"),
        // The value that is named is a default; the one that breaks its rule is this one.
        ("[pipeline]\ntop_k = 2000", "pipeline.top_k is set by"),
        ("[http]\n\nlisten = 127.0.0.1:80", "line 3"),
    ] {
        std::fs::write(&path, text).unwrap();
        let error = Config::load(Some(&path), &Overrides::default()).unwrap_err();
        let error = error.to_string();
        let file = format!("the configuration file {}", path.display());
        assert!(error.contains(&file), "{text:?}: {error:?} names no file");
        assert!(error.contains(key), "{error:?} does not name {key:?}");
    }
}

#[test]
fn a_file_that_cannot_be_read_is_named() {
    let directory = tempfile::tempdir().unwrap();
    let missing = directory.path().join("missing.toml");
    let not_text = directory.path().join("not-text.toml");
    std::fs::write(&not_text, [0xff, 0xfe, 0x00]).unwrap();
    // A directory is there, but has no text to read.
    for path in [missing.as_path(), not_text.as_path(), directory.path()] {
        let error = Config::load(Some(path), &Overrides::default()).unwrap_err();
        assert!(matches!(error, ConfigError::Unreadable { .. }), "{error:?}");
        let name = path.display().to_string();
        assert!(error.to_string().contains(&name), "{error}");
    }
}

#[test]
fn errors_in_the_environment_name_the_variable() {
    for (variable, value) in [
        ("PLACEFORMER_HTTP__MAX_PAGE", "many"),
        ("PLACEFORMER_HTTP__MAX_PAGE", "0"),
        ("PLACEFORMER_LOG__FILTER", "placeformer=loud"),
        ("PLACEFORMER_EXTRACT__HEAD", "none"),
        ("PLACEFORMER_HTTP__LISTEN_ON", "x"),
        ("PLACEFORMER_WEB__LISTEN", "x"),
    ] {
        let error = from_variable(variable, value).unwrap_err().to_string();
        let named = format!("the environment variable {variable}");
        assert!(error.contains(&named), "{variable}={value}: {error}");
    }
}

#[test]
fn errors_in_flags_name_the_flag() {
    let log = Overrides {
        log: Some("placeformer=loud".into()),
        ..Default::default()
    };
    let model = ModelOverrides {
        head: Some(HeadChoice::None),
        ..Default::default()
    };
    let head = Overrides {
        model,
        ..Default::default()
    };
    for (overrides, flag) in [(log, "the flag --log"), (head, "the flag --head")] {
        let error = Config::load(None, &overrides).unwrap_err().to_string();
        assert!(error.contains(flag), "{error:?} does not name {flag:?}");
    }
}
