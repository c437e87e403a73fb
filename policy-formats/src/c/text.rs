//! Pieces of C.

use std::fmt::Write as _;

/// Width of generated lines.
const WIDTH: usize = 110;

/// Returns a number of single precision as a constant that reads back to the same bits.
pub(super) fn number(x: f32) -> String {
    format!("{x:?}f")
}

/// Returns text that stays within a comment: one line of ASCII without the ends of comments and without trigraphs.
pub(super) fn comment(text: &str) -> String {
    let plain: String = text
        .chars()
        .map(|c| match c {
            '−' => '-',
            c if c.is_ascii_graphic() => c,
            _ => ' ',
        })
        .collect();
    let line = plain.split_whitespace().collect::<Vec<_>>().join(" ");
    // twice, because the replaced pairs may overlap
    line.replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?").replace("??", "? ?")
}

/// Returns text as lines of a comment.
pub(super) fn wrapped(text: &str) -> String {
    let mut lines = String::new();
    let mut line = String::new();
    for word in comment(text).split(' ') {
        if !line.is_empty() && line.len() + word.len() + 4 > WIDTH {
            let _ = writeln!(lines, " * {line}");
            line.clear();
        }
        line += if line.is_empty() { "" } else { " " };
        line += word;
    }
    let _ = writeln!(lines, " * {line}");
    lines
}

/// Returns a template with a value in place of each `@key@`.
pub(super) fn fill(template: &str, values: &[(&str, String)]) -> String {
    let replaced = |text: String, (key, value): &(&str, String)| text.replace(&format!("@{key}@"), value);
    values.iter().fold(template.to_string(), replaced)
}

/// Returns a constant array.
pub(super) fn array(of: &str, name: &str, values: impl ExactSizeIterator<Item = String>) -> String {
    let mut text = format!("static const {of} {name}[{}] = {{\n", values.len());
    let mut line = String::from("   ");
    for value in values {
        if line.len() + value.len() + 2 > WIDTH {
            text += &line;
            text += "\n";
            line = String::from("   ");
        }
        let _ = write!(line, " {value},");
    }
    text += line.trim_end_matches(',');
    text += "\n};\n\n";
    text
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn numbers_read_back_to_the_same_bits(bits in any::<u32>()) {
            let x = f32::from_bits(bits);
            prop_assume!(x.is_finite());
            let text = number(x);
            let digits = text.strip_suffix('f').unwrap();
            prop_assert!(digits.contains('.') || digits.contains('e'), "{}", text);
            prop_assert_eq!(digits.parse::<f32>().unwrap().to_bits(), bits);
        }

        #[test]
        fn comments_stay_comments(text in "[*/?\n a-z−😀]{0,200}") {
            let lines = wrapped(&text);
            prop_assert!(!lines.contains("*/") && !lines.contains("/*") && !lines.contains("??"), "{}", lines);
            prop_assert!(lines.lines().all(|line| line.starts_with(" *")) && lines.is_ascii());
        }
    }
}
