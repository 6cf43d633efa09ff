//! Parsers for values that are chosen by name.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use placeformer_lab::choice::Choice;

/// Accepts the names of `T`, and lists them in the help.
pub(super) fn choice<T: Choice>() -> impl TypedValueParser<Value = T> {
    let values = T::ALL
        .iter()
        .map(|value| PossibleValue::new(value.as_str()).help(value.description()));
    PossibleValuesParser::new(values).try_map(|name| {
        // The list above has let through nothing but names of values.
        T::from_name(&name).ok_or("it is none of the values")
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::{Arg, Command};
    use placeformer_lab::datasets::DatasetKind;

    #[test]
    fn every_name_is_accepted_shown_and_told_from_others() {
        let argument = Arg::new("kind").value_parser(choice::<DatasetKind>());
        let mut command = Command::new("test").arg(argument);
        // Long descriptions are wrapped to the width of the terminal.
        let help = command.render_long_help().to_string();
        let help = help.split_whitespace().collect::<Vec<_>>().join(" ");
        for kind in DatasetKind::ALL {
            let parsed = command
                .try_get_matches_from_mut(["test", kind.as_str()])
                .unwrap();
            assert_eq!(parsed.get_one::<DatasetKind>("kind"), Some(kind));
            assert!(help.contains(kind.as_str()), "{help}");
            assert!(help.contains(kind.description()), "{help}");
        }
        assert!(
            command
                .try_get_matches_from_mut(["test", "msls"])
                .unwrap_err()
                .to_string()
                .contains("msls-val")
        );
    }
}
