//! Configuration files: loaded and printable, or refused; what is printed loads as the same
//! settings.
#![no_main]

use libfuzzer_sys::fuzz_target;
use placeformer::config::{Config, Overrides};

fuzz_target!(|text: &str| {
    let path = std::env::temp_dir().join(format!("placeformer-fuzz-{}.toml", std::process::id()));
    std::fs::write(&path, text).expect("the scratch file is writable");
    if let Ok(config) = Config::load(Some(&path), &Overrides::default()) {
        let printed = config
            .to_annotated_toml()
            .expect("what was loaded can be printed");
        std::fs::write(&path, &printed).expect("the scratch file is writable");
        let again = Config::load(Some(&path), &Overrides::default())
            .expect("what was printed can be loaded");
        assert_eq!(again, config, "printed as\n{printed}");
    }
});
