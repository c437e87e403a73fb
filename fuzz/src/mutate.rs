//! Mutations of text and bytes.

use rand::RngExt as _;
use rand_chacha::ChaCha8Rng;

/// Edge cases of numbers for parsers and simulators.
const NUMBERS: [&str; 32] = [
    "0",
    "-0.0",
    "1",
    "-1",
    "2",
    "3",
    "7",
    "0.5",
    "1e-4",
    "1e-9",
    "1e-320",
    "1e3",
    "1e4",
    "1e5",
    "1e9",
    "1e15",
    "1e16",
    "1e300",
    "1e400",
    "0e999",
    "-1e15",
    "nan",
    "inf",
    "-inf",
    "255",
    "256",
    "4294967296",
    "-2147483649",
    "9223372036854775808",
    "18446744073709551616",
    "0x10",
    "\"1\"",
];

/// Bytes with a meaning in the input formats.
const BYTES: &[u8] = b"\n\r\t ,;=#\"'[]{}()<>/\\-+.eE0123456789_\0\x0b\x7f\x80\xc3\xef\xff";

/// Largest input, bytes.
const MAX_BYTES: usize = 1 << 16;

fn below(rng: &mut ChaCha8Rng, end: usize) -> usize {
    if end == 0 { 0 } else { rng.random_range(0..end) }
}

fn pick<'a, T>(rng: &mut ChaCha8Rng, from: &'a [T]) -> Option<&'a T> {
    from.get(below(rng, from.len()))
}

/// Returns a position in the input: in the first 2 KiB, where headers are, as often as in the whole input.
fn place(rng: &mut ChaCha8Rng, length: usize) -> usize {
    const HEAD: usize = 2048;
    let end = if rng.random() { length } else { length.min(HEAD) };
    below(rng, end)
}

/// Returns the ranges of the words of a text: letters, digits, points, signs and underscores.
fn words(input: &[u8]) -> Vec<std::ops::Range<usize>> {
    let in_word = |byte: &u8| byte.is_ascii_alphanumeric() || matches!(byte, b'.' | b'-' | b'+' | b'_');
    let (mut found, mut start) = (Vec::new(), None);
    for (index, byte) in input.iter().chain(b" ").enumerate() {
        match (in_word(byte), start) {
            (true, None) => start = Some(index),
            (false, Some(from)) => {
                found.push(from..index);
                start = None;
            }
            _ => {}
        }
    }
    found
}

/// Returns the ranges of the lines of a text, including line ends.
fn lines(input: &[u8]) -> Vec<std::ops::Range<usize>> {
    let mut start = 0;
    let ends = input.iter().enumerate().filter(|(_, byte)| **byte == b'\n').map(|(index, _)| index + 1);
    let mut found: Vec<_> = ends
        .map(|end| {
            let line = start..end;
            start = end;
            line
        })
        .collect();
    found.push(start..input.len());
    found
}

fn is_number(word: &[u8]) -> bool {
    word.iter().any(u8::is_ascii_digit) && word.iter().all(|byte| b"0123456789.-+eE_".contains(byte))
}

/// Replaces a word by a number or a word of another input.
fn change_word(rng: &mut ChaCha8Rng, input: &mut Vec<u8>, other: &[u8]) {
    let all = words(input);
    let numbers: Vec<_> = all.iter().filter(|range| is_number(&input[(*range).clone()])).cloned().collect();
    let chosen = if rng.random_bool(0.8) && !numbers.is_empty() { pick(rng, &numbers) } else { pick(rng, &all) };
    let Some(range) = chosen.cloned() else { return };
    let theirs = words(other);
    let new = match pick(rng, &theirs) {
        Some(word) if rng.random_bool(0.4) => other[word.clone()].to_vec(),
        _ => match pick(rng, &NUMBERS) {
            Some(number) => number.as_bytes().to_vec(),
            None => return,
        },
    };
    input.splice(range, new);
}

/// Deletes, duplicates or moves a line, or inserts one of another input.
fn change_lines(rng: &mut ChaCha8Rng, input: &mut Vec<u8>, other: &[u8]) {
    let own = lines(input);
    let Some(line) = pick(rng, &own).cloned() else { return };
    match below(rng, 4) {
        0 => drop(input.drain(line)),
        1 => {
            let copy = input[line.clone()].to_vec();
            let at = pick(rng, &own).map_or(0, |line| line.start);
            input.splice(at..at, copy);
        }
        2 => {
            let copy: Vec<u8> = input.drain(line).collect();
            let at = below(rng, input.len() + 1);
            let at = input[..at].iter().rposition(|byte| *byte == b'\n').map_or(0, |index| index + 1);
            input.splice(at..at, copy);
        }
        _ => {
            let theirs = lines(other);
            let Some(their) = pick(rng, &theirs).cloned() else { return };
            input.splice(line.start..line.start, other[their].to_vec());
        }
    }
}

fn change_bytes(rng: &mut ChaCha8Rng, input: &mut Vec<u8>) {
    let at = place(rng, input.len());
    match below(rng, 5) {
        0 => {
            if let Some(byte) = input.get_mut(at) {
                *byte ^= 1 << below(rng, 8);
            }
        }
        1 => {
            if let (Some(byte), Some(new)) = (input.get_mut(at), BYTES.get(rng.random_range(0..BYTES.len()))) {
                *byte = *new;
            }
        }
        2 => {
            let new: Vec<u8> = (0..=below(rng, 4)).filter_map(|_| pick(rng, BYTES).copied()).collect();
            input.splice(at..at, new);
        }
        3 => {
            let end = (at + 1 + below(rng, 16)).min(input.len());
            input.drain(at.min(end)..end);
        }
        _ => {
            let end = (at + 1 + below(rng, 64)).min(input.len());
            let copy = input[at.min(end)..end].to_vec();
            let to = place(rng, input.len());
            input.splice(to..to, copy);
        }
    }
}

/// Returns a mutation of an input of the pool.
///
/// ```
/// use rand_chacha::ChaCha8Rng;
/// use rand_chacha::rand_core::SeedableRng as _;
///
/// let pool = [b"mass = 0.027\n".to_vec()];
/// let draw = |seed| fuzz::mutate::mutate(&mut ChaCha8Rng::seed_from_u64(seed), &pool);
/// assert_eq!(draw(1), draw(1), "the same for equal seeds");
/// assert!((0..20).any(|seed| draw(seed) != pool[0]));
/// ```
pub fn mutate(rng: &mut ChaCha8Rng, pool: &[Vec<u8>]) -> Vec<u8> {
    let mut input = pick(rng, pool).cloned().unwrap_or_default();
    for _ in 0..=below(rng, 6) {
        let other = pick(rng, pool).map_or(&[][..], Vec::as_slice);
        match below(rng, 10) {
            0..=4 => change_word(rng, &mut input, other),
            5 | 6 => change_lines(rng, &mut input, other),
            _ => change_bytes(rng, &mut input),
        }
    }
    input.truncate(MAX_BYTES);
    input
}
