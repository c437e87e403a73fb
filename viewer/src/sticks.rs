//! Gamepads.

use std::time::{Duration, Instant};

use evdev::{AbsoluteAxisCode, Device, KeyCode};

/// All gamepads of the machine. Without permission to read them there are none.
#[derive(Default)]
pub(crate) struct Gamepads {
    devices: Vec<Gamepad>,
    /// Time of the last search for new gamepads.
    searched: Option<Instant>,
}

struct Gamepad {
    device: Device,
    /// Range of each axis in use.
    axes: [(AbsoluteAxisCode, [i32; 2]); 4],
    /// Positions of the axes, from −1 to 1.
    values: [f64; 4],
}

/// Left stick: x, y; right stick: x, y, in the kernel's standard for gamepads.
const AXES: [AbsoluteAxisCode; 4] =
    [AbsoluteAxisCode::ABS_X, AbsoluteAxisCode::ABS_Y, AbsoluteAxisCode::ABS_RX, AbsoluteAxisCode::ABS_RY];

/// Time between searches for new gamepads.
const SEARCH: Duration = Duration::from_secs(2);

/// Fraction of the range around the centre in which a stick counts as released.
const DEAD: f64 = 0.08;

impl Gamepads {
    /// Returns the sticks: up, left turn, forward, right, from −1 to 1.
    ///
    /// The left stick is thrust and yaw, the right stick is pitch and roll (mode 2 of model aircraft).
    pub fn read(&mut self) -> [f64; 4] {
        if self.searched.is_none_or(|searched| searched.elapsed() > SEARCH && self.devices.is_empty()) {
            self.searched = Some(Instant::now());
            self.devices = evdev::enumerate().filter_map(|(_, device)| Gamepad::new(device)).collect();
        }
        self.devices.retain_mut(|gamepad| gamepad.update().is_ok());
        self.devices.first().map_or([0.0; 4], |gamepad| sticks(gamepad.values))
    }
}

impl Gamepad {
    /// Returns a device that has the buttons and sticks of a gamepad.
    fn new(device: Device) -> Option<Self> {
        let has_button = device.supported_keys().is_some_and(|keys| keys.contains(KeyCode::BTN_SOUTH));
        let axes = device.supported_absolute_axes()?;
        if !(has_button && AXES.iter().all(|&axis| axes.contains(axis))) {
            return None;
        }
        let states = device.get_abs_state().ok()?;
        let axes = AXES.map(|axis| {
            let info = states[usize::from(axis.0)];
            (axis, [info.minimum, info.maximum])
        });
        let values = axes.map(|(axis, range)| centred(states[usize::from(axis.0)].value, range));
        device.set_nonblocking(true).ok()?;
        Some(Self { device, axes, values })
    }

    fn update(&mut self) -> std::io::Result<()> {
        let events = match self.device.fetch_events() {
            Ok(events) => events,
            Err(error) if error.kind() == std::io::ErrorKind::WouldBlock => return Ok(()),
            Err(error) => return Err(error),
        };
        for event in events {
            if let evdev::EventSummary::AbsoluteAxis(_, code, value) = event.destructure()
                && let Some(index) = self.axes.iter().position(|(axis, _)| *axis == code)
            {
                self.values[index] = centred(value, self.axes[index].1);
            }
        }
        Ok(())
    }
}

/// Returns a position of an axis from −1 to 1, 0 around the centre.
fn centred(value: i32, [low, high]: [i32; 2]) -> f64 {
    let (low, high) = (f64::from(low), f64::from(high));
    if high <= low {
        return 0.0;
    }
    let x = (2.0 * (f64::from(value) - low) / (high - low) - 1.0).clamp(-1.0, 1.0);
    if x.abs() < DEAD { 0.0 } else { x.signum() * (x.abs() - DEAD) / (1.0 - DEAD) }
}

/// Returns up, left turn, forward and right from the axes, which point right and down.
fn sticks([x, y, rx, ry]: [f64; 4]) -> [f64; 4] {
    [-y, -x, -ry, rx]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_centred_with_a_dead_zone() {
        for range in [[-32_768, 32_767], [0, 255], [-1, 1]] {
            let [low, high] = range;
            assert_eq!([centred(low, range), centred(high, range)], [-1.0, 1.0]);
        }
        assert_eq!(centred(127, [0, 255]), 0.0);
        assert_eq!(centred(5, [3, 3]), 0.0);
        let small = centred(-3_000, [-32_768, 32_767]);
        assert!(small < 0.0 && small > -0.02, "continuous at the edge of the dead zone: {small}");
    }

    #[test]
    fn sticks_point_up_left_forward_and_right() {
        // the left stick is pushed up and to the right, the right stick down and to the left
        let [up, left, forward, right] = sticks([1.0, -1.0, -1.0, 1.0]);
        assert_eq!([up, left, forward, right], [1.0, -1.0, -1.0, -1.0]);
    }
}
