//! Real time.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Times of control steps.
#[derive(Debug, Default)]
pub(super) struct Clock {
    /// Time at which the last step was due.
    last: Option<Instant>,
    /// Times of the steps of the last second.
    recent: VecDeque<Instant>,
}

/// Delay after which the flight gives up the lost time instead of catching up.
const GIVE_UP: Duration = Duration::from_millis(200);

impl Clock {
    /// Forgets the last step: the next one is due at once.
    pub fn restart(&mut self) {
        self.last = None;
        self.recent.clear();
    }

    /// Returns the time of the next step, `seconds` after the last one.
    pub fn due(&self, seconds: f64) -> Instant {
        let now = Instant::now();
        match self.last {
            Some(last) => (last + Duration::from_secs_f64(seconds)).max(now.checked_sub(GIVE_UP).unwrap_or(now)),
            None => now,
        }
    }

    /// Returns true if a time has come.
    pub fn is_due(&self, due: Instant) -> bool {
        due <= Instant::now()
    }

    /// Counts a step that was due at a time. Steps follow the time at which they were due, so that delays do not add
    /// up.
    pub fn count(&mut self, due: Instant) {
        self.last = Some(due);
        let now = Instant::now();
        self.recent.push_back(now);
        while self.recent.len() > 2 && self.recent.front().is_some_and(|&first| now - first > Duration::from_secs(1)) {
            self.recent.pop_front();
        }
    }

    /// Returns the steps per second, averaged over the last second.
    pub fn rate(&self) -> f64 {
        match (self.recent.front(), self.recent.back()) {
            (Some(&first), Some(&last)) if last > first => {
                (self.recent.len() - 1) as f64 / (last - first).as_secs_f64()
            }
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Steps that come late do not make the following ones late.
    #[test]
    fn delays_do_not_add_up() {
        let mut clock = Clock::default();
        let start = Instant::now();
        for index in 0..50 {
            let due = clock.due(0.004);
            while !clock.is_due(due) {
                std::thread::sleep(Duration::from_micros(100));
            }
            clock.count(due);
            if index % 10 == 5 {
                std::thread::sleep(Duration::from_millis(6));
            }
        }
        let last = clock.last.unwrap() - start;
        assert!((last.as_secs_f64() - 49.0 * 0.004).abs() < 1e-3, "{last:?}");
    }

    #[test]
    fn long_interruptions_are_given_up() {
        let mut clock = Clock::default();
        clock.count(clock.due(0.01));
        std::thread::sleep(Duration::from_millis(400));
        let mut caught_up = 0;
        while clock.is_due(clock.due(0.01)) {
            clock.count(clock.due(0.01));
            caught_up += 1;
        }
        assert!((18..30).contains(&caught_up), "{caught_up}");
        clock.restart();
        assert!(clock.is_due(clock.due(0.01)));
    }
}
