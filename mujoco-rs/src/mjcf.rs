//! Validation of scenes before MuJoCo parses and compiles them.
//!
//! MuJoCo's compiler trusts sizes, counts and indices in a scene and in its files: a height field of 65,536 by
//! 65,536 points or a face with an invalid vertex index makes it access memory out of bounds. This module therefore
//! parses the text first and passes MuJoCo a normalized copy, one element per line, so that both parsers agree on
//! its meaning.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use quick_xml::events::{BytesStart, Event};
use quick_xml::{Reader, XmlVersion};

use crate::error::Error;
use crate::limits::{MAX_COORDINATE, MAX_COUNT, MAX_LENGTH, MIN_LENGTH};
use crate::mesh::{self, FileKind};
use crate::model::Assets;

/// Location of a scene's files.
pub(crate) enum Source<'a> {
    Memory(&'a Assets),
    /// Directory of the scene's file.
    Directory(&'a Path),
}

/// Validated scene for MuJoCo.
pub(crate) struct Checked {
    pub(crate) text: String,
    /// Content of the scene's files, by their names without directories, in lower case as MuJoCo compares them.
    pub(crate) files: BTreeMap<String, Vec<u8>>,
}

/// Attributes whose values are names.
const NAMES: &[&str] = &[
    "name",
    "class",
    "childclass",
    "model",
    "file",
    "prefix",
    "data",
    "mesh",
    "hfield",
    "material",
    "texture",
    "body",
    "body1",
    "body2",
    "geom",
    "geom1",
    "geom2",
    "joint",
    "joint1",
    "joint2",
    "jointinparent",
    "site",
    "cranksite",
    "slidersite",
    "refsite",
    "sidesite",
    "tendon",
    "tendon1",
    "tendon2",
    "actuator",
    "target",
    "objname",
    "refname",
    "gridlayout",
    "meshdir",
    "texturedir",
];

/// Attributes whose values may be infinite.
const UNBOUNDED: &[&str] = &["range", "ctrlrange", "forcerange", "actrange", "lengthrange", "cutoff"];

/// Attributes whose values are lengths, positions or directions.
const LENGTHS: &[&str] = &[
    "size",
    "pos",
    "fromto",
    "refpos",
    "vertex",
    "normal",
    "spacing",
    "offset",
    "origin",
    "margin",
    "gap",
    "o_margin",
    "quat",
    "axisangle",
    "euler",
    "xyaxes",
    "zaxis",
    "axis",
    "dir",
    "refquat",
    "bindpos",
    "bindquat",
    "center",
    "extent",
    "anchor",
    "scale",
];

/// Integer attributes that determine MuJoCo's allocations: element, attribute, minimum, maximum.
const COUNTS: &[(&str, &str, i64, i64)] = &[
    ("size", "njmax", -1, 100_000),
    ("size", "nconmax", -1, 1_000_000),
    ("size", "nstack", -1, i32::MAX as i64),
    ("size", "nuserdata", 0, MAX_COUNT),
    ("size", "nkey", 0, 100_000),
    ("size", "nuser_body", -1, 10_000),
    ("size", "nuser_jnt", -1, 10_000),
    ("size", "nuser_geom", -1, 10_000),
    ("size", "nuser_site", -1, 10_000),
    ("size", "nuser_cam", -1, 10_000),
    ("size", "nuser_tendon", -1, 10_000),
    ("size", "nuser_actuator", -1, 10_000),
    ("size", "nuser_sensor", -1, 10_000),
    ("numeric", "size", 1, 500),
    ("user", "dim", 0, 100_000),
    ("texture", "width", 1, 1 << 13),
    ("texture", "height", 1, 1 << 16),
    ("texture", "gridsize", 1, 12),
    ("hfield", "nrow", 2, MAX_COUNT),
    ("hfield", "ncol", 2, MAX_COUNT),
    ("composite", "count", 1, 1_000),
    ("skin", "subgrid", 0, 20),
    ("global", "offwidth", 1, 1 << 14),
    ("global", "offheight", 1, 1 << 14),
    ("quality", "shadowsize", 0, 1 << 14),
    ("quality", "offsamples", 0, 64),
    ("quality", "numslices", 3, 1_000),
    ("quality", "numstacks", 2, 1_000),
    ("quality", "numquads", 1, 1_000),
    ("option", "iterations", 0, 1_000_000),
    ("option", "noslip_iterations", 0, 1_000_000),
    ("option", "mpr_iterations", 0, 1_000_000),
];

/// Largest nesting depth of elements, including those around an include: bounds MuJoCo's recursion to the stack
/// that loading requires.
const MAX_DEPTH: usize = 200;

/// Largest number of parts of a composite object.
const MAX_COMPOSITE: i64 = 10_000;

/// Largest number of values of a custom field: the length of MuJoCo's buffer.
const MAX_NUMERIC: usize = 500;

#[derive(Default)]
struct Scan {
    references: Vec<Reference>,
    mesh_directory: String,
    texture_directory: String,
    strip_path: bool,
    meshes: Vec<MeshReach>,
    /// Largest default scale of meshes.
    default_scale: f64,
    /// Largest scale of a geom that is fitted to a mesh.
    fit: f64,
}

/// Extent of a mesh.
struct MeshReach {
    /// Largest absolute coordinate before scaling.
    reach: f64,
    /// Largest of the mesh's own scale factors.
    scale: Option<f64>,
}

struct Reference {
    kind: FileKind,
    file: String,
    line: usize,
    /// Nesting depth of the referring element.
    depth: usize,
    /// Largest scale factor of a mesh.
    scale: Option<f64>,
}

/// File that the scene refers to.
struct Found {
    kind: FileKind,
    /// Name of the file in the scene.
    file: String,
    /// Largest absolute coordinate of a mesh.
    reach: f64,
}

/// Validates a scene, its includes and its files.
pub(crate) fn check(xml: &str, source: &Source<'_>, shown: &str) -> Result<Checked, Error> {
    let refuse = |message: String| Error::Load { source_name: shown.to_string(), message };
    let mut scan = Scan { default_scale: 1.0, fit: 1.0, ..Scan::default() };
    let text = scan.read(xml, true, 0).map_err(refuse)?;
    let mut files: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    let mut found: BTreeMap<String, Found> = BTreeMap::new();
    let mut next = 0;
    // includes add references during the loop; the directories are known only after all includes have been read
    for includes in [true, false] {
        while let Some(reference) = scan.references.get(next) {
            next += 1;
            if (reference.kind == FileKind::Include) != includes {
                continue;
            }
            let (kind, file, line) = (reference.kind, reference.file.clone(), reference.line);
            let (depth, scale) = (reference.depth, reference.scale);
            let bare = file.rsplit(['/', '\\']).next().unwrap_or_default().to_ascii_lowercase();
            let earlier = found.get(&bare);
            if let Some(Found { reach, .. }) = earlier.filter(|earlier| earlier.kind == kind && earlier.file == file) {
                scan.meshes.push(MeshReach { reach: *reach, scale });
                continue;
            }
            let asset = |reason: String| Error::Asset { name: file.clone(), reason };
            let bytes = source.find(&scan, kind, &file, &bare).map_err(asset)?;
            if bytes.is_empty() {
                return Err(asset("the file is empty".into()));
            }
            let (bytes, reach) = if kind == FileKind::Include {
                let included = std::str::from_utf8(&bytes).map_err(|_| asset("the file is not UTF-8 text".into()))?;
                (scan.read(included, false, depth).map_err(asset)?.into_bytes(), 0.0)
            } else {
                let (checked, reach) = mesh::check(kind, &bare, &bytes).map_err(asset)?;
                scan.meshes.push(MeshReach { reach, scale });
                (checked.into_owned(), reach)
            };
            // MuJoCo finds files by these names only
            if let Some(earlier) = earlier
                && files.get(&bare) != Some(&bytes)
            {
                return Err(refuse(format!(
                    "line {line}: file `{file}` and file `{}` differ: expected one file of each name",
                    earlier.file
                )));
            }
            found.insert(bare.clone(), Found { kind, file, reach });
            files.insert(bare, bytes);
        }
        next = 0;
    }
    let reaches = scan.meshes.iter().map(|mesh| mesh.reach * mesh.scale.unwrap_or(scan.default_scale));
    let largest = reaches.fold(0.0, f64::max) * scan.fit;
    if largest > MAX_LENGTH {
        return Err(refuse(format!("a mesh reaches {largest} m from its origin, expected at most {MAX_LENGTH} m")));
    }
    Ok(Checked { text, files })
}

impl Source<'_> {
    fn find(&self, scan: &Scan, kind: FileKind, file: &str, bare: &str) -> Result<Vec<u8>, String> {
        match self {
            Self::Memory(assets) => {
                let mut found = assets.iter().filter(|(name, _)| name.eq_ignore_ascii_case(bare));
                found.next().map(|(_, bytes)| bytes.to_vec()).ok_or_else(|| {
                    "the scene refers to it, but it is not among the assets (scenes in memory read no files)".into()
                })
            }
            Self::Directory(directory) => {
                let below = match kind {
                    FileKind::Mesh | FileKind::Skin | FileKind::HeightField => scan.mesh_directory.as_str(),
                    FileKind::Texture => scan.texture_directory.as_str(),
                    FileKind::Include => "",
                };
                let name = match file.rsplit(['/', '\\']).next() {
                    Some(bare) if scan.strip_path && kind != FileKind::Include => bare,
                    _ => file,
                };
                let path = directory.join(below).join(name);
                std::fs::read(&path).map_err(|error| format!("{}: {error}", path.display()))
            }
        }
    }
}

impl Scan {
    /// Parses one text at a nesting depth of `around` elements, and returns the normalized text for MuJoCo.
    fn read(&mut self, xml: &str, is_main: bool, around: usize) -> Result<String, String> {
        let mut reader = Reader::from_str(xml);
        let mut clean = String::with_capacity(xml.len() + xml.len() / 8);
        let (mut line, mut counted, mut written_line) = (1, 0, 1);
        let (mut depth, mut roots) = (0_usize, 0_usize);
        loop {
            let position = usize::try_from(reader.buffer_position()).unwrap_or(counted).min(xml.len());
            line += xml.as_bytes()[counted..position].iter().filter(|&&byte| byte == b'\n').count();
            counted = position;
            let syntax = |what: &dyn std::fmt::Display| format!("XML error at line {line}: {what}");
            let event = reader.read_event().map_err(|error| syntax(&error))?;
            let is_empty = matches!(event, Event::Empty(_));
            match event {
                Event::Start(tag) | Event::Empty(tag) => {
                    if depth == 0 {
                        roots += 1;
                        let name = tag.name().0;
                        if roots > 1 || (is_main && !name.eq_ignore_ascii_case("mujoco")) {
                            return Err(syntax(&format!("element `{name}`, expected one root element, `mujoco`")));
                        }
                    }
                    while written_line < line {
                        clean.push('\n');
                        written_line += 1;
                    }
                    self.element(&tag, line, around + depth, &mut clean)?;
                    clean.push_str(if is_empty { "/>" } else { ">" });
                    depth += usize::from(!is_empty);
                    if around + depth > MAX_DEPTH {
                        return Err(format!("line {line}: elements are nested more than {MAX_DEPTH} deep"));
                    }
                }
                Event::End(tag) => {
                    depth -= 1;
                    _ = write!(clean, "</{}>", tag.name().0);
                }
                Event::DocType(_) => return Err(syntax(&"a document type, expected none")),
                Event::Eof => break,
                // MuJoCo reads only elements and attributes
                _ => {}
            }
        }
        match (depth, roots) {
            (0, 1..) => Ok(clean),
            (0, _) => Err("XML error: the text has no element".into()),
            _ => Err(format!("XML error at line {line}: {depth} elements are not closed")),
        }
    }

    fn element(&mut self, tag: &BytesStart<'_>, line: usize, depth: usize, clean: &mut String) -> Result<(), String> {
        let name = tag.name().0;
        let plain = |name: &str| name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_-.:".contains(&byte));
        if !plain(name) {
            return Err(format!(
                "XML error at line {line}: `{name}`, expected letters, digits, `_`, `-`, `.` and `:` in a name"
            ));
        }
        _ = write!(clean, "<{name}");
        let mut attributes = Vec::new();
        for attribute in tag.attributes() {
            let attribute = attribute.map_err(|error| format!("XML error at line {line}: {error}"))?;
            let (key, value) = (attribute.key.0, attribute.normalized_value(XmlVersion::Explicit1_0));
            let value = value.map_err(|error| format!("XML error at line {line}: {error}"))?;
            if !plain(key) || value.chars().any(|letter| letter.is_control()) {
                return Err(format!(
                    "XML error at line {line}: attribute `{key}` has a name or letters that XML does not allow"
                ));
            }
            _ = write!(clean, " {key}=\"{}\"", quick_xml::escape::escape(value.as_ref()));
            attributes.push((key.to_string(), value.into_owned()));
        }
        let element = Element { name, line, attributes: &attributes };
        element.check_numbers()?;
        element.check_counts()?;
        let scale = element.scale()?;
        self.references_of(&element, depth, scale)?;
        match name {
            "mesh" => {
                let reach = element.faces()?;
                match (element.get("file"), element.get("vertex"), scale) {
                    (None, None, Some(scale)) => self.default_scale = self.default_scale.max(scale),
                    _ => self.meshes.push(MeshReach { reach, scale }),
                }
                Ok(())
            }
            "skin" => element.faces().map(|_| ()),
            "compiler" => {
                for (key, directory) in
                    [("meshdir", &mut self.mesh_directory), ("texturedir", &mut self.texture_directory)]
                {
                    if let Some(value) = element.get(key) {
                        *directory = value.to_string();
                    }
                }
                self.strip_path |= element.get("strippath") == Some("true");
                Ok(())
            }
            "geom" => {
                if let Some(fit) = element.get("fitscale") {
                    let fit: f64 =
                        fit.trim().parse().map_err(|_| element.wrong("fitscale", fit, "a positive number"))?;
                    if !(1e-6..=1e6).contains(&fit) {
                        return Err(element.wrong("fitscale", &fit.to_string(), "1e-6 to 1e6"));
                    }
                    self.fit = self.fit.max(fit);
                }
                Ok(())
            }
            _ => Ok(()),
        }
    }

    fn references_of(&mut self, element: &Element<'_>, depth: usize, scale: Option<f64>) -> Result<(), String> {
        let kind = match element.name {
            "mesh" => FileKind::Mesh,
            "skin" => FileKind::Skin,
            "hfield" => FileKind::HeightField,
            "texture" => FileKind::Texture,
            name if name.eq_ignore_ascii_case("include") => FileKind::Include,
            _ => return Ok(()),
        };
        for (key, file) in element.attributes.iter().filter(|(key, _)| key.starts_with("file")) {
            let bare = file.rsplit(['/', '\\']).next().unwrap_or_default();
            if bare.is_empty() || bare.len() >= mujoco_sys::mjMAXVFSNAME as usize {
                return Err(element.wrong(key, file, "a file name of 1 to 999 bytes"));
            }
            self.references.push(Reference { kind, file: file.clone(), line: element.line, depth, scale });
        }
        Ok(())
    }
}

/// Element and its attributes.
struct Element<'a> {
    name: &'a str,
    line: usize,
    attributes: &'a [(String, String)],
}

impl Element<'_> {
    fn get(&self, key: &str) -> Option<&str> {
        self.attributes.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_str())
    }

    fn wrong(&self, key: &str, got: &str, expected: &str) -> String {
        let shown: String = got.chars().take(60).collect();
        format!("line {}: {key} of <{}> is `{shown}`, expected {expected}", self.line, self.name)
    }

    fn numbers<T: std::str::FromStr>(&self, key: &str, value: &str) -> Result<Vec<T>, String> {
        let parse = |word: &str| word.parse().map_err(|_| self.wrong(key, word, "numbers"));
        value.split_ascii_whitespace().map(parse).collect()
    }

    /// Checks that numbers are finite, and that lengths are within MuJoCo's range.
    fn check_numbers(&self) -> Result<(), String> {
        for (key, value) in self.attributes {
            let key = key.as_str();
            if NAMES.contains(&key) || key.starts_with("file") {
                continue;
            }
            for word in value.split_ascii_whitespace() {
                let Ok(number) = word.parse::<f64>() else { continue };
                if number.is_nan() || (number.is_infinite() && !UNBOUNDED.contains(&key)) {
                    return Err(self.wrong(key, word, "finite numbers"));
                }
                if LENGTHS.contains(&key) && number.abs() > MAX_COORDINATE {
                    return Err(self.wrong(key, word, "numbers of at most 1e10"));
                }
                if key == "size" && number != 0.0 && !(MIN_LENGTH..=MAX_LENGTH).contains(&number.abs()) {
                    return Err(self.wrong(key, word, "0, or 1e-15 to 1e6"));
                }
                if ["fromto", "margin", "gap", "o_margin"].contains(&key) && number.abs() > MAX_LENGTH {
                    return Err(self.wrong(key, word, "numbers of at most 1e6"));
                }
                if key == "mpr_tolerance" && number < 1e-12 {
                    return Err(self.wrong(key, word, "at least 1e-12"));
                }
            }
        }
        Ok(())
    }

    /// Checks the integer attributes that determine MuJoCo's allocations.
    fn check_counts(&self) -> Result<(), String> {
        for &(element, key, min, max) in COUNTS {
            if element != self.name {
                continue;
            }
            let Some(value) = self.get(key) else { continue };
            let numbers = self.numbers::<i64>(key, value)?;
            if numbers.is_empty() || numbers.iter().any(|number| !(min..=max).contains(number)) {
                return Err(self.wrong(key, value, &format!("whole numbers from {min} to {max}")));
            }
            if numbers.iter().fold(1_i64, |all, &number| all.saturating_mul(number)) > MAX_COMPOSITE && key == "count" {
                return Err(self.wrong(key, value, &format!("a product of at most {MAX_COMPOSITE}")));
            }
        }
        let number = |key: &str| self.get(key).and_then(|value| value.trim().parse::<i64>().ok());
        match (self.name, number("nrow"), number("ncol"), number("width"), number("height")) {
            ("hfield", Some(rows), Some(columns), ..) => {
                mesh::height_field(rows, columns).map_err(|what| format!("line {}: {what}", self.line))
            }
            ("texture", _, _, Some(width), Some(height)) if width.saturating_mul(height) > MAX_COUNT => {
                Err(self.wrong("height", &height.to_string(), "a smaller texture"))
            }
            ("numeric", ..)
                if self.get("data").is_some_and(|data| data.split_ascii_whitespace().count() > MAX_NUMERIC) =>
            {
                Err(self.wrong("data", "longer", "at most 500 numbers"))
            }
            _ => Ok(()),
        }
    }

    /// Returns the largest of a mesh's scale factors; `None` if it has no scale.
    fn scale(&self) -> Result<Option<f64>, String> {
        let Some(scale) = self.get("scale").filter(|_| self.name == "mesh") else { return Ok(None) };
        Ok(Some(self.numbers::<f64>("scale", scale)?.into_iter().fold(0.0, |max: f64, x| max.max(x.abs()))))
    }

    /// Checks the vertices and faces in the text: faces must name existing vertices. Returns the largest absolute
    /// coordinate.
    fn faces(&self) -> Result<f64, String> {
        if self.get("file").is_some()
            && ["vertex", "normal", "texcoord", "face"].iter().any(|key| self.get(key).is_some())
        {
            return Err(self.wrong("vertex", "given with a file", "either vertices or a file"));
        }
        let vertices = self.get("vertex").map_or(Ok(Vec::new()), |value| self.numbers::<f64>("vertex", value))?;
        let count = (vertices.len() / 3) as i64;
        if self.name == "mesh" && self.get("vertex").is_some() && count < 4 {
            return Err(self.wrong("vertex", &format!("{count} points"), "at least 4"));
        }
        if let Some(value) = self.get("face") {
            let faces = self.numbers::<i64>("face", value)?;
            if let Some(index) = faces.iter().find(|index| !(0..count).contains(*index)) {
                return Err(self.wrong(
                    "face",
                    &index.to_string(),
                    &format!("indices below the number of vertices, {count}"),
                ));
            }
        }
        Ok(vertices.iter().fold(0.0, |max: f64, x| max.max(x.abs())))
    }
}
