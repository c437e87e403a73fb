//! Flights that a person changes: pause, push, rewind, steer.

mod support;

use std::sync::mpsc;
use std::thread::JoinHandle;
use std::time::Duration;

use aviary::control::ControllerKind;
use aviary::env::{DroneEnv, EnvConfig};
use aviary::rollout::{ControllerPolicy, PilotedPolicy, Rollout};
use aviary::state::DroneState;
use aviary::tasks::make;
use support::{CONTROL, Display, UP, in_display, wait_until};
use viewer::{LiveFlight, PilotedRollout, Turn, Viewer, ViewerOptions};

type Piloted = Rollout<Box<dyn DroneEnv>, PilotedPolicy<ControllerPolicy>>;

struct Flight(Piloted);

impl PilotedRollout for Flight {
    type Policy = ControllerPolicy;

    fn rollout(&self) -> &Piloted {
        &self.0
    }

    fn rollout_mut(&mut self) -> &mut Piloted {
        &mut self.0
    }

    fn name(&self) -> String {
        "dsl".into()
    }
}

/// Report of the loop of a flight after every turn.
#[derive(Debug, Clone)]
struct Report {
    step: u64,
    states: Vec<DroneState>,
    turn: Turn,
    is_paused: bool,
    message: Option<String>,
    piloted: Option<usize>,
}

struct Run {
    reports: mpsc::Receiver<Report>,
    last: Report,
    all: Vec<Report>,
    thread: Option<JoinHandle<()>>,
}

impl Run {
    /// Flies an episode of 60 s in a window, on another thread.
    fn start(display: &Display, task: &'static str, is_interactive: bool) -> Self {
        let (sender, reports) = mpsc::channel();
        let fly = move || {
            let env: Box<dyn DroneEnv> = make(task, EnvConfig::default().episode_seconds(60.0)).unwrap();
            let policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Dsl, &env));
            let mut flight = Flight(Rollout::start(env, policy, Some(3)).unwrap());
            let options = ViewerOptions {
                title: "live".into(),
                size: [640, 480],
                panels: false,
                is_pretty: Some(false),
                ..ViewerOptions::default()
            };
            let viewer = Viewer::open(&**flight.0.env(), options).unwrap();
            let mut live = LiveFlight::new(viewer, Some(3), is_interactive);
            loop {
                let is_over = flight.0.is_over();
                let turn = live.turn(&mut flight, is_over).unwrap();
                if turn == Turn::Step {
                    flight.0.step().unwrap();
                }
                let simulation = flight.0.env().simulation();
                let report = Report {
                    step: simulation.control_steps(),
                    states: simulation.states().to_vec(),
                    turn,
                    is_paused: live.status().is_paused,
                    message: live.status().message.clone(),
                    piloted: live.status().piloted,
                };
                // the test may have ended
                if sender.send(report).is_err() || turn == Turn::Closed {
                    break;
                }
            }
        };
        let thread = std::thread::spawn(fly);
        let last = reports.recv_timeout(Duration::from_secs(20)).expect("the first control step");
        let window = display.windows("live", 1)[0];
        display.focus(window);
        Self { reports, all: vec![last.clone()], last, thread: Some(thread) }
    }

    /// Reads the reports until one satisfies a condition.
    fn until(&mut self, what: &str, is_so: impl Fn(&Report) -> bool) -> Report {
        wait_until(what, || {
            while let Ok(report) = self.reports.try_recv() {
                self.last = report.clone();
                self.all.push(report);
                if is_so(&self.last) {
                    return Some(self.last.clone());
                }
            }
            None
        })
    }

    /// Waits until the flight makes no control steps any more.
    fn until_still(&mut self) -> Report {
        std::thread::sleep(Duration::from_millis(400));
        while let Ok(report) = self.reports.try_recv() {
            self.last = report.clone();
            self.all.push(report);
        }
        self.last.clone()
    }

    /// Closes the window and returns all reports.
    fn close(mut self, display: &Display) -> Vec<Report> {
        display.close(display.windows("live", 1)[0]);
        self.until("the end of the loop", |report| report.turn == Turn::Closed);
        self.thread.take().unwrap().join().unwrap();
        self.all
    }
}

#[test]
fn a_paused_flight_makes_single_steps() {
    in_display("a_paused_flight_makes_single_steps", |display| {
        let mut run = Run::start(&display, "hover", true);
        run.until("some steps", |report| report.step > 20);
        display.text(" ");
        let paused = run.until_still();
        assert_eq!(run.until_still().step, paused.step);
        display.text("...");
        run.until("three steps", |report| report.step == paused.step + 3 && report.is_paused);
        assert_eq!(run.until_still().step, paused.step + 3);
        display.text(" ");
        run.until("the flight to go on", |report| report.step > paused.step + 20);
        run.close(&display);
    });
}

/// A rewound flight is bit-identical to the first one from the shown state on: environment and controller.
#[test]
fn a_flight_goes_on_from_an_earlier_state() {
    in_display("a_flight_goes_on_from_an_earlier_state", |display| {
        let mut run = Run::start(&display, "hover", true);
        run.until("some steps", |report| report.step >= 60);
        display.text(" ");
        let paused = run.until_still();
        for _ in 0..10 {
            display.key(support::LEFT);
        }
        display.text("c");
        let rewound = run.until("the earlier state", |report| report.turn == Turn::Rewound);
        assert_eq!(rewound.step, paused.step - 10);
        display.text(" ");
        run.until("the flight to go on", |report| !report.is_paused && report.step > paused.step);
        let all = run.close(&display);
        let back = all.iter().position(|report| report.turn == Turn::Rewound).unwrap();
        let states = |reports: &[Report], step: u64| {
            reports.iter().find(|report| report.step == step).map(|report| report.states.clone()).unwrap()
        };
        for step in paused.step - 9..=paused.step {
            assert_eq!(states(&all[back..], step), states(&all[..back], step), "{step}");
        }
    });
}

#[test]
fn the_mouse_pushes_a_selected_drone() {
    in_display("the_mouse_pushes_a_selected_drone", |display| {
        let mut run = Run::start(&display, "multi_hover", true);
        let hovering = run.until("hovering", |report| report.step > 200);
        display.key(0xff56); // Page Down selects the first drone
        std::thread::sleep(Duration::from_millis(200));
        display.key_down(CONTROL);
        display.move_to(300, 240);
        display.press(1);
        for x in 1..=12 {
            display.move_to(300 + 10 * x, 240);
        }
        let distance =
            |report: &Report, drone: usize| (report.states[drone].position - hovering.states[drone].position).norm();
        let pushed = run.until("the drone to move", |report| distance(report, 0) > 0.03);
        assert!(distance(&pushed, 1) < 0.01, "the other drone hovers");
        display.release(1);
        display.key_up(CONTROL);
        // a flight that goes on from a state during the push has no push
        display.text(" ");
        run.until_still();
        for _ in 0..5 {
            display.key(support::LEFT);
        }
        display.text("c");
        run.until("the earlier state", |report| report.turn == Turn::Rewound);
        display.text(" ");
        run.until("the drone to return", |report| distance(report, 0) < 0.01);
        run.close(&display);
    });
}

#[test]
fn a_person_flies_a_drone_by_hand() {
    in_display("a_person_flies_a_drone_by_hand", |display| {
        let mut run = Run::start(&display, "hover", true);
        let hovering = run.until("hovering", |report| report.step > 150);
        display.text("k");
        run.until("the control", |report| report.piloted == Some(0));
        display.key_down(UP);
        let forwards = |report: &Report| report.states[0].position.x - hovering.states[0].position.x;
        run.until("a flight forwards", |report| forwards(report) > 0.2);
        display.key_up(UP);
        display.text("k");
        run.until("the return to the controller", |report| report.piloted.is_none());
        run.until("the target", |report| forwards(report).abs() < 0.02);
        run.close(&display);
    });
}

#[test]
fn episodes_restart_with_the_same_seed() {
    in_display("episodes_restart_with_the_same_seed", |display| {
        let mut run = Run::start(&display, "hover", true);
        run.until("some steps", |report| report.step > 30);
        display.key(support::BACKSPACE);
        run.until("another episode", |report| report.turn == Turn::Restarted && report.step == 0);
        run.until("some steps", |report| report.step > 30);
        let all = run.close(&display);
        let restart = all.iter().position(|report| report.turn == Turn::Restarted).unwrap();
        for step in 1..=30 {
            let of = |reports: &[Report]| reports.iter().find(|report| report.step == step).unwrap().states.clone();
            assert_eq!(of(&all[restart..]), of(&all[..restart]));
        }
    });
}

#[test]
fn the_last_state_is_shown_before_the_end() {
    in_display("the_last_state_is_shown_before_the_end", |display| {
        let env: Box<dyn DroneEnv> = make("hover", EnvConfig::default().episode_seconds(0.5)).unwrap();
        let policy = PilotedPolicy::new(ControllerPolicy::new(ControllerKind::Dsl, &env));
        let mut flight = Flight(Rollout::start(env, policy, Some(3)).unwrap());
        let options = ViewerOptions { title: "end".into(), is_pretty: Some(false), ..ViewerOptions::default() };
        let mut live = LiveFlight::new(Viewer::open(&**flight.0.env(), options).unwrap(), Some(3), false);
        display.windows("end", 1);
        while !flight.0.is_over() {
            assert_eq!(live.turn(&mut flight, false), Ok(Turn::Step));
            flight.0.step().unwrap();
        }
        live.show_end(&flight).unwrap();
        assert_eq!(live.viewer().status().step, 24);
    });
}

/// A flight that only shows its window can be paused, but not changed.
#[test]
fn a_watched_flight_cannot_be_changed() {
    in_display("a_watched_flight_cannot_be_changed", |display| {
        let mut run = Run::start(&display, "hover", false);
        run.until("some steps", |report| report.step > 10);
        display.text("nkc ");
        display.key(support::BACKSPACE);
        let paused = run.until_still();
        assert!(paused.piloted.is_none() && paused.step > 10);
        display.text(" ");
        run.until("the flight to go on", |report| report.step > paused.step + 10);
        let all = run.close(&display);
        assert!(all.iter().all(|report| matches!(report.turn, Turn::Step | Turn::Closed)));
        assert!(all.windows(2).all(|pair| pair[0].step <= pair[1].step && pair[1].message.is_none()));
    });
}
