//! The manual of the configuration file.
//!
//! Every setting is explained in one place, the doc comment of its field. The schemas that `utoipa`
//! derives from the settings structs carry those comments, so this module collects them from there
//! and writes each one above its key.

use serde_json::Value;
use std::fmt::Write;
use utoipa::ToSchema;

/// The head of the printed file.
const INTRODUCTION: &str = "\
# PlaceFormer's settings as they are in force. Every key may be left out.
# Each can also be set in the environment: PLACEFORMER_HTTP__LISTEN is `listen` of [http].
# Flags win over the environment, the environment over this file, this file over the defaults.
";

/// One table of the configuration file.
pub(super) struct Section {
    /// Its name, such as `http`.
    pub(super) name: String,
    /// What its settings are about.
    pub(super) explanation: String,
    /// Its keys by name.
    pub(super) settings: Vec<Setting>,
}

/// One key of a section.
pub(super) struct Setting {
    /// Its name, such as `listen`.
    pub(super) name: String,
    /// What it means: one or more lines.
    pub(super) explanation: String,
}

/// The sections of `T`, a struct whose fields are the structs of the sections.
pub(super) fn sections<T: ToSchema>() -> Vec<Section> {
    let schemas = Schemas::of::<T>();
    let sections = properties(&schemas.root).map(|(name, field)| {
        let settings = schemas.referenced(field).into_iter().flat_map(properties);
        Section {
            name: name.clone(),
            explanation: description(field),
            settings: settings
                .map(|(name, field)| Setting {
                    name: name.clone(),
                    explanation: schemas.explanation(field),
                })
                .collect(),
        }
    });
    sections.collect()
}

/// `values` as TOML, each key under its explanation. Keys without a value are commented out.
pub(super) fn annotated(values: &toml::Table, sections: &[Section]) -> String {
    let mut text = String::from(INTRODUCTION);
    for section in sections {
        text.push('\n');
        push_comment(&mut text, &section.explanation);
        push_line(&mut text, format_args!("[{}]", section.name));

        let values = values.get(&section.name).and_then(toml::Value::as_table);
        let value_of = |setting: &Setting| values.and_then(|values| values.get(&setting.name));
        let (set, unset): (Vec<_>, Vec<_>) = section
            .settings
            .iter()
            .partition(|setting| value_of(setting).is_some());
        for setting in set.into_iter().chain(unset) {
            push_comment(&mut text, &setting.explanation);
            match value_of(setting) {
                Some(value) => push_line(&mut text, format_args!("{} = {value}", setting.name)),
                None => push_line(&mut text, format_args!("# {} =", setting.name)),
            }
        }
    }
    text
}

fn push_comment(text: &mut String, comment: &str) {
    for line in comment.lines() {
        push_line(text, format_args!("# {line}"));
    }
}

fn push_line(text: &mut String, line: std::fmt::Arguments<'_>) {
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{line}");
}

/// The JSON schemas of a struct and of everything it refers to.
struct Schemas {
    root: Value,
    by_name: Vec<(String, Value)>,
}

impl Schemas {
    fn of<T: ToSchema>() -> Self {
        // A schema consists of maps with text keys, which JSON can always express.
        let as_json = |schema| serde_json::to_value(schema).unwrap_or_default();
        let mut named = Vec::new();
        T::schemas(&mut named);
        Self {
            root: as_json(T::schema()),
            by_name: named
                .into_iter()
                .map(|(name, schema)| (name, as_json(schema)))
                .collect(),
        }
    }

    /// The struct that a field is of, if the field refers to one.
    fn referenced(&self, field: &Value) -> Option<&Value> {
        let reference = find_reference(field)?;
        let wanted = reference.rsplit('/').next()?;
        let (_, schema) = self.by_name.iter().find(|(name, _)| name == wanted)?;
        Some(schema)
    }

    /// The doc comment of a field, followed by those of its own fields if it is a list of structs.
    fn explanation(&self, field: &Value) -> String {
        let mut text = description(field);
        let Some(element) = self.referenced(field) else {
            return text;
        };
        text.push_str("\nEach of them has");
        for (name, inner) in properties(element) {
            let explanation = description(inner).replace('\n', "\n  ");
            // Writing to a string cannot fail.
            let _ = write!(text, "\n  {name}: {explanation}");
        }
        text
    }
}

fn properties(schema: &Value) -> impl Iterator<Item = (&String, &Value)> {
    schema["properties"].as_object().into_iter().flatten()
}

fn description(schema: &Value) -> String {
    let text = schema["description"].as_str().unwrap_or_default();
    text.to_owned()
}

/// The first `$ref` within a field's schema: a list or an optional field wraps it.
fn find_reference(schema: &Value) -> Option<&str> {
    match schema {
        Value::Object(fields) => match fields.get("$ref") {
            Some(reference) => reference.as_str(),
            None => fields.values().find_map(find_reference),
        },
        Value::Array(elements) => elements.iter().find_map(find_reference),
        _ => None,
    }
}
