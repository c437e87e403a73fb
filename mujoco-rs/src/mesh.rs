//! Validation of a scene's files before MuJoCo reads them, because MuJoCo's readers trust the indices and sizes in
//! files.

use std::borrow::Cow;
use std::fmt::Write as _;

use crate::limits::{MAX_COORDINATE, MAX_COUNT};

/// Role of a file in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum FileKind {
    Mesh,
    Skin,
    HeightField,
    Texture,
    Include,
}

/// Validates a file and returns the content for MuJoCo, with the largest coordinate of a mesh.
pub(crate) fn check<'a>(kind: FileKind, name: &str, bytes: &'a [u8]) -> Result<(Cow<'a, [u8]>, f64), String> {
    let ends_with = |extension: &str| {
        let start = name.len().checked_sub(extension.len());
        start.and_then(|start| name.get(start..)).is_some_and(|end| end.eq_ignore_ascii_case(extension))
    };
    match kind {
        FileKind::Mesh if ends_with("obj") => obj(bytes).map(|(text, reach)| (Cow::Owned(text.into_bytes()), reach)),
        FileKind::Mesh if ends_with("stl") => stl(bytes).map(|reach| (Cow::Borrowed(bytes), reach)),
        FileKind::Mesh if ends_with("msh") => msh(bytes).map(|reach| (Cow::Borrowed(bytes), reach)),
        FileKind::Mesh => Err("expected a mesh file that ends with .obj, .stl or .msh".into()),
        FileKind::Skin if ends_with("skn") => skn(bytes).map(|()| (Cow::Borrowed(bytes), 0.0)),
        FileKind::Skin => Err("expected a skin file that ends with .skn".into()),
        FileKind::HeightField | FileKind::Texture => {
            if name.len() < 5 {
                return Err("expected a file name of at least five letters".into());
            }
            let size = if ends_with(".png") { png(bytes)? } else { custom(kind, bytes)? };
            if kind == FileKind::HeightField {
                height_field(size[1], size[0])?;
            }
            Ok((Cow::Borrowed(bytes), 0.0))
        }
        FileKind::Include => Ok((Cow::Borrowed(bytes), 0.0)),
    }
}

/// Validates the dimensions of a height field. MuJoCo's ray casting indexes the sides of a field as if it were
/// square.
pub(crate) fn height_field(rows: i64, columns: i64) -> Result<(), String> {
    if rows < 2 || columns < rows || rows.saturating_mul(columns) > MAX_COUNT {
        return Err(format!(
            "the height field has {rows} rows and {columns} columns, expected at least 2 rows, at least as many \
             columns as rows (a limit of MuJoCo's ray casting), and at most {MAX_COUNT} points"
        ));
    }
    Ok(())
}

/// Returns normalized OBJ text for tinyobjloader: vertices, texture coordinates, normals, faces with absolute
/// indices and the starts of groups, one per line. Numbers are not reformatted.
fn obj(bytes: &[u8]) -> Result<(String, f64), String> {
    let text = String::from_utf8_lossy(bytes).replace("\r\n", "\n").replace('\r', "\n");
    let mut all = [0_i64; 3];
    for line in text.lines() {
        match words(line).next() {
            Some("v") => all[0] += 1,
            Some("vt") => all[1] += 1,
            Some("vn") => all[2] += 1,
            _ => {}
        }
    }
    let mut clean = String::with_capacity(text.len());
    let (mut seen, mut faces, mut reach) = ([0_i64; 3], 0_usize, 0.0_f64);
    for (number, line) in text.lines().enumerate() {
        let wrong = |what: String| format!("line {}: {what}", number + 1);
        let words: Vec<&str> = words(line).collect();
        let Some((&key, words)) = words.split_first() else { continue };
        let (list, numbers) = match key {
            "v" => (0, 3),
            "vt" => (1, 2),
            "vn" => (2, 3),
            "f" => {
                if !(3..=64).contains(&words.len()) {
                    return Err(wrong(format!("a face of {} corners, expected 3 to 64", words.len())));
                }
                clean.push('f');
                for corner in words {
                    let indices = face_corner(corner, seen, all).map_err(wrong)?;
                    clean.push(' ');
                    for (place, index) in indices.into_iter().enumerate() {
                        match index {
                            Some(index) if place == 0 => _ = write!(clean, "{index}"),
                            Some(index) => _ = write!(clean, "/{index}"),
                            None if place == 1 && all[2] > 0 => clean.push('/'),
                            None => {}
                        }
                    }
                }
                clean.push('\n');
                faces += 1;
                continue;
            }
            // MuJoCo reads only the first group
            "g" | "o" => {
                _ = writeln!(clean, "{key} part");
                continue;
            }
            _ => continue,
        };
        seen[list] += 1;
        let short = key == "vt" && words.len() == 1;
        if words.len() < numbers && !short {
            return Err(wrong(format!("`{key}` with {} numbers, expected {numbers}", words.len())));
        }
        clean.push_str(key);
        for &word in words.iter().take(numbers) {
            let plain = word.bytes().all(|byte| byte.is_ascii_digit() || b"+-.eE".contains(&byte));
            match word.parse::<f64>() {
                Ok(value) if plain && value.abs() <= MAX_COORDINATE => {
                    if list == 0 {
                        reach = reach.max(value.abs());
                    }
                    _ = write!(clean, " {word}");
                }
                _ => return Err(wrong(format!("`{word}`, expected a finite number of at most 1e10"))),
            }
        }
        clean.push_str(if short { " 0\n" } else { "\n" });
    }
    if all[0] < 4 || faces == 0 {
        return Err(format!("{} vertices and {faces} faces, expected at least 4 vertices and a face", all[0]));
    }
    Ok((clean, reach))
}

fn words(line: &str) -> impl Iterator<Item = &str> {
    line.split([' ', '\t']).filter(|word| !word.is_empty())
}

/// Parses a face's corner `v`, `v/vt`, `v//vn` or `v/vt/vn` into absolute indices. If the file has texture
/// coordinates or normals, MuJoCo reads one for every corner, also if the corner names none.
fn face_corner(corner: &str, seen: [i64; 3], all: [i64; 3]) -> Result<[Option<i64>; 3], String> {
    const NAMES: [&str; 3] = ["vertex", "texture coordinate", "normal"];
    let mut parts = corner.split('/');
    let mut indices = [None; 3];
    for (place, index) in indices.iter_mut().enumerate() {
        let part = parts.next().unwrap_or_default();
        let what = NAMES[place];
        if part.is_empty() {
            if place == 0 || all[place] > 0 {
                return Err(format!(
                    "corner `{corner}` names no {what}, expected one for every corner{}",
                    if place == 0 { "" } else { " of a file that has any" }
                ));
            }
            continue;
        }
        let absolute = match part.parse::<i32>() {
            Ok(value) if value < 0 => seen[place] + 1 + i64::from(value),
            Ok(value) => i64::from(value),
            Err(_) => 0,
        };
        if absolute < 1 || absolute > all[place] {
            return Err(format!("corner `{corner}` names {what} `{part}`, the file has {}", all[place]));
        }
        *index = Some(absolute);
    }
    match parts.next() {
        None => Ok(indices),
        Some(_) => Err(format!("corner `{corner}`, expected vertex/texture/normal")),
    }
}

/// Reader of the little-endian numbers of a binary file.
struct Binary<'a>(&'a [u8]);

impl Binary<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (first, rest) = self.0.split_first_chunk::<N>().ok_or("the file ends too early")?;
        self.0 = rest;
        Ok(*first)
    }

    fn int(&mut self) -> Result<i64, String> {
        self.take().map(|bytes| i64::from(i32::from_le_bytes(bytes)))
    }

    /// Reads a count between 0 and [`MAX_COUNT`].
    fn count(&mut self, what: &str) -> Result<i64, String> {
        match self.int()? {
            count if (0..=MAX_COUNT).contains(&count) => Ok(count),
            count => Err(format!("the number of {what} is {count}, expected 0 to {MAX_COUNT}")),
        }
    }

    /// Skips finite numbers and returns their largest absolute value.
    fn floats(&mut self, count: i64, what: &str) -> Result<f64, String> {
        let mut largest = 0.0_f64;
        for _ in 0..count {
            let value = f64::from(f32::from_le_bytes(self.take()?));
            if value.is_nan() || value.abs() > MAX_COORDINATE {
                return Err(format!("{what} has the number {value}, expected finite ones of at most 1e10"));
            }
            largest = largest.max(value.abs());
        }
        Ok(largest)
    }

    /// Skips vertex indices and checks them.
    fn indices(&mut self, count: i64, vertices: i64, what: &str) -> Result<(), String> {
        for _ in 0..count {
            let index = self.int()?;
            if !(0..vertices).contains(&index) {
                return Err(format!("{what} names vertex {index}, the file has {vertices}"));
            }
        }
        Ok(())
    }

    fn end(&self) -> Result<(), String> {
        if self.0.is_empty() { Ok(()) } else { Err(format!("{} bytes after the data", self.0.len())) }
    }
}

fn stl(bytes: &[u8]) -> Result<f64, String> {
    let Some((_, body)) = bytes.split_first_chunk::<80>() else {
        return Err("the file is shorter than the header of a binary STL file".into());
    };
    let mut file = Binary(body);
    let faces = file.count("triangles")?;
    if !(1..=200_000).contains(&faces) || file.0.len() as i64 != 50 * faces {
        return Err(format!(
            "{faces} triangles in {} bytes, expected 1 to 200000 of 50 bytes each: MuJoCo reads only binary STL files",
            file.0.len()
        ));
    }
    let mut reach = 0.0_f64;
    for _ in 0..faces {
        file.take::<12>()?; // the normal, which MuJoCo recomputes
        reach = reach.max(file.floats(9, "a triangle")?);
        file.take::<2>()?;
    }
    file.end()?;
    Ok(reach)
}

fn msh(bytes: &[u8]) -> Result<f64, String> {
    let mut file = Binary(bytes);
    let [vertices, normals, textures, faces] =
        [file.count("vertices")?, file.count("normals")?, file.count("texture coordinates")?, file.count("faces")?];
    if vertices < 4 || ![0, vertices].contains(&normals) || ![0, vertices].contains(&textures) {
        return Err(format!(
            "{vertices} vertices, {normals} normals and {textures} texture coordinates, expected at least 4 \
             vertices, and as many of the others or none"
        ));
    }
    let reach = file.floats(3 * vertices, "a vertex")?;
    file.floats(3 * normals, "a normal")?;
    file.floats(2 * textures, "a texture coordinate")?;
    file.indices(3 * faces, vertices, "a face")?;
    file.end()?;
    Ok(reach)
}

fn skn(bytes: &[u8]) -> Result<(), String> {
    let mut file = Binary(bytes);
    let [vertices, textures, faces, bones] =
        [file.count("vertices")?, file.count("texture coordinates")?, file.count("faces")?, file.count("bones")?];
    file.floats(3 * vertices, "a vertex")?;
    file.floats(2 * textures, "a texture coordinate")?;
    file.indices(3 * faces, vertices, "a face")?;
    for _ in 0..bones {
        if file.take::<40>()?.iter().all(|&byte| byte != 0) {
            return Err("the name of a bone's body is not terminated".into());
        }
        file.floats(7, "a bone")?;
        let held = file.count("a bone's vertices")?;
        file.indices(held, vertices, "a bone")?;
        file.floats(held, "a bone's weight")?;
    }
    file.end()
}

/// Returns the width and height of a PNG file.
fn png(bytes: &[u8]) -> Result<[i64; 2], String> {
    let header = bytes.strip_prefix(b"\x89PNG\r\n\x1a\n").and_then(|rest| rest.get(8..16));
    let Some(Ok(header)) = header.map(<[u8; 8]>::try_from) else {
        return Err("the file is not a PNG image".into());
    };
    let number =
        |at: usize| i64::from(u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]));
    dimensions(number(0), number(4))
}

/// Returns the width and height of MuJoCo's own format for height fields and textures, whose data must match them
/// exactly.
fn custom(kind: FileKind, bytes: &[u8]) -> Result<[i64; 2], String> {
    let mut file = Binary(bytes);
    let (first, second) = (file.int()?, file.int()?);
    let (size, bytes_each) = match kind {
        // rows and columns of floats
        FileKind::HeightField => (dimensions(second, first)?, 4),
        _ => (dimensions(first, second)?, 3),
    };
    if file.0.len() as i64 != size[0] * size[1] * bytes_each {
        return Err(format!("{} bytes of data for {} by {} points", file.0.len(), size[0], size[1]));
    }
    if kind == FileKind::HeightField {
        file.floats(size[0] * size[1], "the field")?;
    }
    Ok(size)
}

fn dimensions(width: i64, height: i64) -> Result<[i64; 2], String> {
    if width < 1 || height < 1 || width.saturating_mul(height) > MAX_COUNT {
        return Err(format!("{width} by {height} points, expected at least 1 by 1 and at most {MAX_COUNT} altogether"));
    }
    Ok([width, height])
}
