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

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Writer of logs.
    pub(crate) struct Writer {
        version: u16,
        header: Vec<u8>,
        types: Vec<Vec<char>>,
        events: Vec<u8>,
    }

    impl Writer {
        pub fn new(version: u16) -> Self {
            Self { version, header: Vec::new(), types: Vec::new(), events: Vec::new() }
        }

        /// Adds an event type and returns its index.
        pub fn event(&mut self, name: &str, variables: &[(&str, char)]) -> usize {
            let id = 7 * self.types.len() as u16 + 3;
            self.header.extend(id.to_le_bytes());
            self.header.extend([name.as_bytes(), b"\0"].concat());
            self.header.extend((variables.len() as u16).to_le_bytes());
            for (name, kind) in variables {
                self.header.extend(format!("{name}({kind})\0").bytes());
            }
            self.types.push(variables.iter().map(|(_, kind)| *kind).collect());
            self.types.len() - 1
        }

        /// Adds an event at a time in µs.
        pub fn sample(&mut self, event: usize, time: u64, numbers: &[f64]) {
            self.events.extend((7 * event as u16 + 3).to_le_bytes());
            match self.version {
                1 => self.events.extend(((time / 1000) as u32).to_le_bytes()),
                _ => self.events.extend(time.to_le_bytes()),
            }
            for (kind, x) in self.types[event].iter().zip(numbers) {
                match kind {
                    'B' => self.events.push(*x as u8),
                    'b' => self.events.extend((*x as i8).to_le_bytes()),
                    'H' => self.events.extend((*x as u16).to_le_bytes()),
                    'h' => self.events.extend((*x as i16).to_le_bytes()),
                    'I' => self.events.extend((*x as u32).to_le_bytes()),
                    'i' => self.events.extend((*x as i32).to_le_bytes()),
                    'f' => self.events.extend((*x as f32).to_le_bytes()),
                    other => panic!("no type {other}"),
                }
            }
        }

        pub fn finish(&self) -> Vec<u8> {
            let mut bytes = vec![MAGIC];
            bytes.extend(self.version.to_le_bytes());
            bytes.extend((self.types.len() as u16).to_le_bytes());
            bytes.extend(&self.header);
            bytes.extend(&self.events);
            bytes.extend(bitwise_crc(&bytes).to_le_bytes());
            bytes
        }
    }

    /// Computes the CRC-32 of IEEE 802.3 bit by bit.
    fn bitwise_crc(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0_u32, |crc, &byte| {
            (0..8).fold(crc ^ u32::from(byte), |crc, _| if crc & 1 == 1 { crc >> 1 ^ 0xEDB8_8320 } else { crc >> 1 })
        })
    }

    /// Returns a log of 3 s at 100 Hz: a straight path at 0.5 m/s while the drone yaws at 90 °/s, and the voltage ten
    /// times a second.
    pub(crate) fn sample(version: u16) -> Vec<u8> {
        let mut writer = Writer::new(version);
        let names = [
            "stateEstimate.x",
            "stateEstimate.y",
            "stateEstimate.z",
            "stateEstimate.vx",
            "stateEstimate.vy",
            "stateEstimate.vz",
            "stateEstimate.qw",
            "stateEstimate.qx",
            "stateEstimate.qy",
            "stateEstimate.qz",
            "gyro.x",
            "gyro.y",
            "gyro.z",
            "acc.x",
            "acc.y",
            "acc.z",
        ];
        let floats = names.map(|name| (name, 'f'));
        let motors = [("motor.m1", 'H'), ("motor.m2", 'H'), ("motor.m3", 'H'), ("motor.m4", 'I')];
        let fixed = writer.event("fixedFrequency", &[&floats[..], &motors, &[("sys.canfly", 'B')]].concat());
        let battery = writer.event("battery", &[("pm.vbat", 'f')]);
        for row in 0..301_u64 {
            let t = 0.01 * row as f64;
            let half = 0.5 * 90_f64.to_radians() * t;
            let (qz, qw) = half.sin_cos();
            let motion = [0.5 * t, 0.0, 1.0, 0.5, 0.0, 0.0, qw, 0.0, 0.0, qz, 0.0, 0.0, 90.0, 0.0, 0.0, 1.0];
            let numbers = [&motion[..], &[30_000.0, 40_000.0, 50_000.0, 60_000.0, 1.0]].concat();
            writer.sample(fixed, 10_000 * row, &numbers);
            if row % 10 == 2 || row == 300 {
                writer.sample(battery, 10_000 * row, &[4.0 - 0.01 * t]);
            }
        }
        writer.finish()
    }

    #[test]
    fn every_type_of_variable_is_read() {
        let mut writer = Writer::new(2);
        let kinds = ['B', 'b', 'H', 'h', 'I', 'i', 'f'];
        let names = kinds.map(|kind| format!("group.{kind}"));
        let variables: Vec<_> = names.iter().map(String::as_str).zip(kinds).collect();
        let event = writer.event("all", &variables);
        let numbers = [[200.0, -100.0, 60_000.0, -30_000.0, 4e9, -2e9, 0.1], [0.0; 7]];
        for (row, numbers) in numbers.iter().enumerate() {
            writer.sample(event, 1_500_000 * row as u64, numbers);
        }
        let log = read(&writer.finish()).unwrap();
        assert_eq!(log.streams[0].times, [0.0, 1.5]);
        for (index, (name, samples)) in log.streams[0].variables.iter().enumerate() {
            let expected = if index == 6 { f64::from(0.1_f32) } else { numbers[0][index] };
            assert_eq!((name, samples), (&names[index], &vec![expected, 0.0]));
        }
        for (bits, expected) in [
            (0x3C00, 1.0),
            (0xC000, -2.0),
            (0x7BFF, 65_504.0),
            (0x0001, 2.0_f64.powi(-24)),
            (0x3555, 0.333_251_953_125),
        ] {
            assert_eq!(half(bits), expected, "{bits:x}");
        }
        assert!(half(0x7C00).is_infinite() && half(0x7E00).is_nan());
    }

    #[test]
    fn damaged_logs_are_errors_with_the_byte() {
        let bytes = sample(2);
        let error = |bytes: &[u8]| read(bytes).unwrap_err();
        let with_checksum = |mut bytes: Vec<u8>| {
            let end = bytes.len() - 4;
            let crc = bitwise_crc(&bytes[..end]).to_le_bytes();
            bytes[end..].copy_from_slice(&crc);
            bytes
        };
        assert_eq!(error(&bytes[..7]), "the log has 7 bytes, expected at least 9");
        assert!(error(&bytes[..bytes.len() - 1]).contains("the log is damaged or incomplete"));
        let mut flipped = bytes.clone();
        flipped[5000] ^= 4;
        assert!(error(&flipped).starts_with("the checksum is "));
        let mut newer = bytes.clone();
        newer[1] = 3;
        assert_eq!(error(&newer), "byte 1: the version is 3, expected 1 or 2");
        // the last event lacks its last bytes
        let cut = with_checksum(bytes[..bytes.len() - 2].to_vec());
        let expected = format!("the log ends after {} bytes within an entry, expected a complete log", cut.len());
        assert_eq!(error(&cut), expected);
        let at = bytes.windows(4).position(|window| window == b"x(f)").unwrap();
        let mut unknown = bytes.clone();
        unknown[at + 2] = b'z';
        assert!(error(&with_checksum(unknown)).contains("variable `stateEstimate.x(z)` of event `fixedFrequency`"));
        let mut other = bytes.clone();
        let first_event = bytes.len() - 4 - (301 * (10 + 64 + 6 + 4 + 1) + 31 * 14);
        other[first_event] = 99;
        let message = error(&with_checksum(other));
        assert!(message.contains("an event of type 99, expected a type of the header"), "{message}");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// The checksum of the damaged log is valid, so that the damage reaches the parser.
        #[test]
        fn damaged_logs_with_a_valid_checksum_are_errors_or_logs(
            version in 1_u16..=2, cut in any::<u16>(),
            damage in prop::collection::vec((any::<u16>(), any::<u8>()), 0..6),
        ) {
            let mut bytes = sample(version);
            for (at, byte) in damage {
                // mostly the header
                let length = if at % 2 == 0 { 500 } else { bytes.len() };
                let at = usize::from(at) % length;
                bytes[at] = byte;
            }
            if cut % 3 == 0 {
                bytes.truncate(usize::from(cut) % bytes.len());
            }
            bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
            match read(&bytes) {
                Ok(log) => {
                    let samples: usize = log.streams.iter().map(|s| s.times.len() * (1 + s.variables.len())).sum();
                    prop_assert!(samples <= bytes.len(), "memory is proportional to the file");
                    let _ = log.table("log00", 0.01);
                }
                Err(error) => prop_assert!(error.lines().count() == 1 && error.chars().count() < 250, "{}", error),
            }
        }
    }
}
