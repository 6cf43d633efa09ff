//! Text from elsewhere, made fit for a terminal.
//!
//! A file may be named so that its name moves the cursor, changes colours, begins a new line of a
//! log, or runs from right to left and shows another ending than it has. Such characters are
//! printed as escapes.

use std::fmt::{self, Display, Write};

/// Prints what it holds with control and formatting characters escaped, in one line.
#[derive(Debug, Clone, Copy)]
pub struct Printable<T>(pub T);

impl<T: Display> Display for Printable<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(Escaping(f), "{}", self.0)
    }
}

/// Escapes what is written to it.
struct Escaping<'a, 'b>(&'a mut fmt::Formatter<'b>);

impl Write for Escaping<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for character in text.chars() {
            if is_harmless(character) {
                self.0.write_char(character)?;
            } else {
                write!(self.0, "{}", character.escape_default())?;
            }
        }
        Ok(())
    }
}

fn is_harmless(character: char) -> bool {
    // Characters without a glyph: soft hyphen, marks of direction, joiners, separators of lines,
    // isolates, the byte order mark, annotations, tags.
    let is_invisible = matches!(
        character,
        '\u{ad}'
            | '\u{61c}'
            | '\u{180e}'
            | '\u{200b}'..='\u{200f}'
            | '\u{2028}'..='\u{202e}'
            | '\u{2060}'..='\u{206f}'
            | '\u{feff}'
            | '\u{fff9}'..='\u{fffb}'
            | '\u{e0000}'..='\u{e0fff}'
    );
    !character.is_control() && !is_invisible
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_moves_the_cursor_or_the_reading_is_escaped() {
        let shown = |text: &str| Printable(text).to_string();
        assert_eq!(shown("a\u{1b}[31mb\nc"), "a\\u{1b}[31mb\\nc");
        assert_eq!(shown("gpj.\u{202e}exe"), "gpj.\\u{202e}exe");
        assert_eq!(shown("\u{9b}1m\u{7f}"), "\\u{9b}1m\\u{7f}");
        assert_eq!(
            shown("it's \"caf\u{e9}\" e\u{301} \\ ok"),
            "it's \"caf\u{e9}\" e\u{301} \\ ok"
        );
    }
}
