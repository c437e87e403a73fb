//! Reader of the binary logs of the Crazyflie's micro-SD card deck.
//!
//! All numbers are little-endian. A name is UTF-8 text that ends in a zero byte. A log has (Bitcraze, "Micro-SD card
//! deck", Crazyflie firmware documentation):
//!
//! ```text
//! u8       0xBC
//! u16      version, 1 or 2
//! u16      number of event types
//! per event type:
//!   u16    identifier
//!   name   name
//!   u16    number of variables
//!   name   of every variable, followed by its type in parentheses, for example "gyro.x(f)"
//! until the last four bytes, per event:
//!   u16    identifier of its type
//!   u32    version 1: time, ms        u64   version 2: time, µs
//!          the values of its variables
//! u32      CRC-32 of all bytes before
//! ```
//!
//! Types are those of Python's `struct`: `B`, `b` (8 bits), `H`, `h` (16), `I`, `i` (32), `f` (float), `e` (half).

use super::raw_log::{CrazyflieLog, Stream};
use super::table::shown;

/// First byte of a log.
pub(super) const MAGIC: u8 = 0xBC;

/// Type of a variable.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Kind {
    U8,
    I8,
    U16,
    I16,
    U32,
    I32,
    F32,
    F16,
}

impl Kind {
    fn of(letter: char) -> Option<Self> {
        Some(match letter {
            'B' => Self::U8,
            'b' => Self::I8,
            'H' => Self::U16,
            'h' => Self::I16,
            'I' => Self::U32,
            'i' => Self::I32,
            'f' => Self::F32,
            'e' => Self::F16,
            _ => return None,
        })
    }

    fn read(self, cursor: &mut Cursor<'_>) -> Result<f64, String> {
        Ok(match self {
            Self::U8 => f64::from(cursor.array::<1>()?[0]),
            Self::I8 => f64::from(i8::from_le_bytes(cursor.array()?)),
            Self::U16 => f64::from(u16::from_le_bytes(cursor.array()?)),
            Self::I16 => f64::from(i16::from_le_bytes(cursor.array()?)),
            Self::U32 => f64::from(u32::from_le_bytes(cursor.array()?)),
            Self::I32 => f64::from(i32::from_le_bytes(cursor.array()?)),
            Self::F32 => f64::from(f32::from_le_bytes(cursor.array()?)),
            Self::F16 => half(u16::from_le_bytes(cursor.array()?)),
        })
    }
}

/// Returns the value of a half-precision number.
fn half(bits: u16) -> f64 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, mantissa) = (i32::from(bits >> 10 & 31), f64::from(bits & 1023));
    sign * match exponent {
        0 => mantissa * 2.0_f64.powi(-24),
        31 if mantissa == 0.0 => f64::INFINITY,
        31 => f64::NAN,
        _ => (1.0 + mantissa / 1024.0) * 2.0_f64.powi(exponent - 15),
    }
}

/// Unread bytes of a log.
struct Cursor<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Cursor<'_> {
    fn array<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let end = self.at + N;
        let array = self.bytes.get(self.at..end).and_then(|bytes| bytes.try_into().ok());
        self.at = end;
        array.ok_or_else(|| self.truncated())
    }

    fn u16(&mut self) -> Result<u16, String> {
        Ok(u16::from_le_bytes(self.array()?))
    }

    fn name(&mut self) -> Result<String, String> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        let length = rest.iter().position(|&byte| byte == 0).ok_or_else(|| self.truncated())?;
        let name = std::str::from_utf8(&rest[..length]);
        let name = name.map_err(|_| format!("byte {}: a name is not UTF-8 text", self.at))?;
        self.at += length + 1;
        Ok(name.to_string())
    }

    fn truncated(&self) -> String {
        format!("the log ends after {} bytes within an entry, expected a complete log", self.bytes.len() + 4)
    }
}

/// Type of an event.
struct EventType {
    id: u16,
    kinds: Vec<Kind>,
    stream: Stream,
}

/// Reads a log. Errors name the offset of a byte.
pub(super) fn read(bytes: &[u8]) -> Result<CrazyflieLog, String> {
    let size = bytes.len();
    let Some((content, crc)) = bytes.split_last_chunk::<4>().filter(|(content, _)| content.len() >= 5) else {
        return Err(format!("the log has {size} bytes, expected at least 9"));
    };
    let mut cursor = Cursor { bytes: content, at: 1 };
    let version = cursor.u16()?;
    if version != 1 && version != 2 {
        return Err(format!("byte 1: the version is {version}, expected 1 or 2"));
    }
    let (computed, stored) = (crc32fast::hash(content), u32::from_le_bytes(*crc));
    if computed != stored {
        return Err(format!("the checksum is {stored:08x}, expected {computed:08x}: the log is damaged or incomplete"));
    }
    let mut types: Vec<EventType> = Vec::new();
    for _ in 0..cursor.u16()? {
        let at = cursor.at;
        let kind = event_type(&mut cursor)?;
        if types.iter().any(|other| other.id == kind.id) {
            return Err(format!("byte {at}: two event types {}, expected one", kind.id));
        }
        types.push(kind);
    }
    while cursor.at < content.len() {
        let at = cursor.at;
        let id = cursor.u16()?;
        let time = match version {
            1 => 1e-3 * f64::from(u32::from_le_bytes(cursor.array()?)),
            _ => 1e-6 * u64::from_le_bytes(cursor.array()?) as f64,
        };
        let Some(kind) = types.iter_mut().find(|kind| kind.id == id) else {
            return Err(format!("byte {at}: an event of type {id}, expected a type of the header"));
        };
        kind.stream.times.push(time);
        for (kind, (_, samples)) in kind.kinds.iter().zip(&mut kind.stream.variables) {
            samples.push(kind.read(&mut cursor)?);
        }
    }
    Ok(CrazyflieLog { streams: types.into_iter().map(|kind| kind.stream).collect() })
}

/// Reads the description of an event type.
fn event_type(cursor: &mut Cursor<'_>) -> Result<EventType, String> {
    let id = cursor.u16()?;
    let event = cursor.name()?;
    let (mut kinds, mut variables) = (Vec::new(), Vec::new());
    for _ in 0..cursor.u16()? {
        let at = cursor.at;
        let text = cursor.name()?;
        let parts = text.strip_suffix(')').and_then(|text| text.rsplit_once('('));
        let found = parts.and_then(|(name, kind)| {
            let mut letters = kind.chars();
            let kind = letters.next().and_then(Kind::of).filter(|_| letters.next().is_none())?;
            Some((name, kind))
        });
        let Some((name, kind)) = found else {
            let (text, event) = (shown(&text), shown(&event));
            return Err(format!("byte {at}: variable `{text}` of event `{event}`, expected a type as in `gyro.x(f)`"));
        };
        kinds.push(kind);
        variables.push((name.to_string(), Vec::new()));
    }
    Ok(EventType { id, kinds, stream: Stream { times: Vec::new(), variables } })
}
