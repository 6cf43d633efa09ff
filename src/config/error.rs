//! Why settings cannot be used, with the source they come from.

use crate::ops::logging::InvalidFilter;
use std::fmt;
use std::path::PathBuf;

/// Why the settings cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ConfigError {
    /// The file is not there or cannot be read.
    #[error("cannot read the configuration file {}", path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The file is not TOML, or a key is unknown or has the wrong type. The text of the inner error
    /// names the key and its source.
    #[error("the configuration is not valid: {0}")]
    Invalid(Box<figment::Error>),
    /// A variable looks like a setting but its levels are joined by one underscore.
    #[error(
        "the environment variable {name} is not a setting: write the section and the key with two \
         underscores between, such as {hint}"
    )]
    Variable {
        /// The variable.
        name: String,
        /// How it is probably meant.
        hint: String,
    },
    /// A value is out of range.
    #[error("the configuration is not valid: {key}: {reason}{}", list(origins))]
    Value {
        /// The key, such as `http.max_page`.
        key: String,
        /// The rule that its value breaks.
        reason: String,
        /// What set the values that the rule is about.
        origins: Vec<Origin>,
    },
    /// Without a head there is no global descriptor to search by.
    #[error(
        "the configuration is not valid: extract.head: a service cannot run with \"none\", because \
         maps are searched by the head's output; leave it at \"default\" or name a file \
         (`placeformer head fit` makes one){}",
        list(origins)
    )]
    NoHead {
        /// What set it.
        origins: Vec<Origin>,
    },
    /// The log filter cannot be parsed.
    #[error("the configuration is not valid: {filter}{}", list(origins))]
    Filter {
        /// The filter and what is wrong with it.
        filter: InvalidFilter,
        /// What set it.
        origins: Vec<Origin>,
    },
    /// The settings cannot be written as TOML.
    #[error("the configuration cannot be printed")]
    Print(#[from] toml::ser::Error),
}

/// What set a value.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Origin {
    /// The key, such as `http.listen`.
    pub key: String,
    /// The source, such as "the flag --listen".
    pub setter: String,
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} is set by {}", self.key, self.setter)
    }
}

/// The origins in brackets, to follow an error's text; nothing where there are none.
fn list(origins: &[Origin]) -> String {
    if origins.is_empty() {
        return String::new();
    }
    let origins: Vec<String> = origins.iter().map(Origin::to_string).collect();
    format!(" ({})", origins.join(", "))
}
