//! Values that people choose by name.
//!
//! A command line or a configuration builds its parser and its help from the list that such a type
//! carries, so that no name is written twice.

/// One of a few values, each of which has a name.
pub trait Choice: Copy + Send + Sync + 'static {
    /// Every value, in the order in which they are shown.
    const ALL: &'static [Self];

    /// The name that people write, such as `msls-val`.
    fn as_str(self) -> &'static str;

    /// What it stands for, as a line of help.
    fn description(self) -> &'static str;

    /// The value of a name; `None` if there is no such name.
    fn from_name(name: &str) -> Option<Self> {
        Self::ALL
            .iter()
            .copied()
            .find(|value| value.as_str() == name)
    }
}
