//! Names, units and frames of the entries of observations and actions.

use aviary::action::ActionType;
use aviary::drone::DroneParams;
use aviary::policy::PolicyInfo;

/// Entry of an observation or an action.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Entry {
    /// Name in upper snake case, unique within an observation or action.
    pub name: String,
    /// Meaning, unit and frame; empty if unknown.
    pub description: String,
}

impl Entry {
    fn new(name: impl Into<String>, description: impl Into<String>) -> Self {
        Self { name: name.into(), description: description.into() }
    }

    /// Returns unnamed entries, of a task that this version does not define.
    fn numbered(prefix: &str, count: usize) -> Vec<Self> {
        (0..count).map(|index| Self::new(format!("{prefix}{index}"), "")).collect()
    }
}

/// Three entries along the axes of a frame.
fn axes(name: &str, meaning: &str, unit: &str) -> [Entry; 3] {
    ["x", "y", "z"]
        .map(|axis| Entry::new(format!("{name}_{}", axis.to_uppercase()), format!("{meaning} along {axis}, {unit}")))
}

/// The first twelve entries of the observation of every task except that of the environment without a task.
fn state() -> Vec<Entry> {
    let angle = |name: &str| Entry::new(name.to_uppercase(), format!("{name} of body to world (ZYX), rad"));
    let mut entries = Vec::from(axes("POSITION", "position", "m, world frame"));
    entries.extend(["roll", "pitch", "yaw"].map(angle));
    entries.extend(axes("VELOCITY", "velocity", "m/s, world frame"));
    entries.extend(axes("ANGULAR_VELOCITY", "angular velocity", "rad/s, body frame"));
    entries
}

/// Returns the entries of the observation of one drone, or `None` for a task that this version does not define.
fn of_task(task: &str) -> Option<Vec<Entry>> {
    let mut entries = state();
    match task {
        "hover" | "stabilize" => {}
        "velocity" => {
            entries.extend(axes("TARGET_VELOCITY", "target velocity", "m/s, world frame"));
            entries.push(Entry::new("TARGET_YAW_RATE", "target yaw rate, rad/s, body frame"));
        }
        "multi_hover" | "multi_agent" => entries.push(Entry::new("TARGET_HEIGHT", "target height, m, world frame")),
        "fly_through" => {
            entries.extend(axes("WAYPOINT", "next waypoint", "m, world frame"));
            entries.extend(axes("RELATIVE_WAYPOINT", "next waypoint relative to the drone", "m, body frame"));
        }
        "race" => {
            entries.extend(axes("GATE", "next gate", "m, world frame"));
            entries.extend(axes("RELATIVE_GATE", "next gate relative to the drone", "m, body frame"));
            entries.extend(axes("GATE_AFTER", "gate after the next, relative to the drone", "m, body frame"));
        }
        "formation" => {
            entries.extend(axes("SLOT", "slot of the drone", "m, world frame"));
            entries.extend(axes("RELATIVE_SLOT", "slot relative to the drone", "m, world frame"));
        }
        "antipodal" => {
            entries.extend(axes("GOAL", "goal", "m, world frame"));
            entries.extend(axes("RELATIVE_GOAL", "goal relative to the drone", "m, world frame"));
        }
        "track" => {
            entries.extend(axes("RELATIVE_REFERENCE", "reference relative to the drone", "m, world frame"));
            entries.extend(axes("REFERENCE_VELOCITY", "velocity of the reference", "m/s, world frame"));
        }
        _ => return None,
    }
    Some(entries)
}

/// Returns the entries of an action of one drone.
fn of_action(action_type: ActionType) -> Vec<Entry> {
    let motors = |meaning: &str| {
        (0..4).map(|motor| Entry::new(format!("MOTOR{motor}"), format!("{meaning} of motor {motor}"))).collect()
    };
    let collective = || Entry::new("THRUST", "collective thrust as a normalized motor speed, −1 to 1, 0 hovers");
    let normalized = "normalized speed (−1 zero, 0 hover, 1 maximum)";
    match action_type {
        ActionType::Rpm => motors(normalized),
        ActionType::RawRpm => motors("speed, rpm,"),
        ActionType::OneDRpm => vec![Entry::new("MOTORS", format!("{normalized} of all motors"))],
        ActionType::Duty => motors("duty (normalized PWM, 0 to 1)"),
        ActionType::Vel => {
            let mut entries = Vec::from(axes("VELOCITY", "velocity", "m/s, heading frame"));
            entries.push(Entry::new("YAW_RATE", "yaw rate, rad/s"));
            entries
        }
        ActionType::Pid => {
            let mut entries = Vec::from(axes("WAYPOINT", "waypoint", "m, world frame"));
            entries.push(Entry::new("YAW", "yaw, rad"));
            entries
        }
        ActionType::Attitude => {
            let angle = |name: &str| Entry::new(name.to_uppercase(), format!("{name} as a share of the largest tilt"));
            let rate = Entry::new("YAW_RATE", "yaw rate as a share of the largest");
            vec![collective(), angle("roll"), angle("pitch"), rate]
        }
        ActionType::Ctbr => {
            let mut entries = vec![collective()];
            entries.extend(axes("BODY_RATE", "angular velocity", "as a share of the largest, body frame"));
            entries
        }
        _ => Vec::new(),
    }
}

/// Returns the number of drones that an observation or action of a policy has entries of.
fn drones(info: &PolicyInfo) -> usize {
    if info.per_drone { 1 } else { info.num_drones }
}

/// Returns the entries of all drones of a policy in their order, given those of one, or `None` unless there are `size`
/// of them.
fn of_drones(info: &PolicyInfo, of_one: &[Entry], size: usize) -> Option<Vec<Entry>> {
    // the number of drones may be any, and must not size the list before it is checked
    if drones(info).checked_mul(of_one.len()) != Some(size) {
        return None;
    }
    if drones(info) == 1 {
        return Some(of_one.to_vec());
    }
    let of_drone = |drone: usize| {
        let named = move |entry: &Entry| {
            let description = format!("{} (drone {drone})", entry.description);
            Entry::new(format!("DRONE{drone}_{}", entry.name), description)
        };
        of_one.iter().map(named)
    };
    Some((0..info.num_drones).flat_map(of_drone).collect())
}

/// Returns the entries of the observation of a policy with `size` entries. They have numbers for names if the task of
/// the policy has another number of entries or is unknown.
///
/// ```
/// use aviary::policy::PolicyNetwork;
/// use policy_formats::layout;
///
/// let policy = PolicyNetwork::load("../assets/policies/hover.safetensors")?;
/// let entries = layout::observation(policy.info(), policy.observation_size());
/// assert_eq!(entries[11].name, "ANGULAR_VELOCITY_Z");
/// assert_eq!(entries[11].description, "angular velocity along z, rad/s, body frame");
/// # Ok::<(), aviary::policy::PolicyError>(())
/// ```
pub fn observation(info: &PolicyInfo, size: usize) -> Vec<Entry> {
    let entries = of_task(&info.task).and_then(|mut entries| {
        // races through frames also observe the directions of the next two gates
        if info.task == "race" && drones(info).checked_mul(entries.len() + 6) == Some(size) {
            entries.extend(axes("GATE_NORMAL", "normal of the next gate", "body frame"));
            entries.extend(axes("GATE_AFTER_NORMAL", "normal of the gate after the next", "body frame"));
        }
        of_drones(info, &entries, size)
    });
    entries.unwrap_or_else(|| Entry::numbered("ENTRY", size))
}

/// Returns the entries of the action of a policy with `size` entries. They have numbers for names if the action type
/// has another number of entries or is unknown.
pub fn action(info: &PolicyInfo, size: usize) -> Vec<Entry> {
    let action_type = info.action_type.parse::<ActionType>().ok();
    let entries = action_type.and_then(|action_type| of_drones(info, &of_action(action_type), size));
    entries.unwrap_or_else(|| Entry::numbered("ENTRY", size))
}

/// Returns what the entries of a policy do not say: the frames, the target of hover, and the motors of an airframe, one
/// sentence or more per line. Tasks that this version does not define have no lines. A policy that was trained with
/// sampled airframes has no motor speeds.
pub fn notes(info: &PolicyInfo, drone: Option<&DroneParams>) -> Vec<String> {
    let mut notes = Vec::new();
    if of_task(&info.task).is_some() {
        let frames =
            "The world frame has z up. The body frame has x forward, y to the left and z up. Yaw is in -pi to pi.";
        notes.push(frames.into());
    }
    if info.task == "hover" {
        notes.push("The drone hovers at (0, 0, 1) m: shift positions to hover elsewhere.".into());
    }
    let action_type = info.action_type.parse::<ActionType>().ok();
    if let (Some(drone), Some(ActionType::Rpm | ActionType::OneDRpm | ActionType::RawRpm | ActionType::Duty)) =
        (drone, action_type)
    {
        let (positions, reactions) = (drone.motor_positions(), drone.allocation().row(3).clone_owned());
        notes.extend(positions.iter().enumerate().map(|(motor, position)| {
            // the body turns against the propeller
            let turns = if reactions[motor] > 0.0 { "clockwise" } else { "counterclockwise" };
            let [x, y] = [position[0], position[1]].map(|metres| (1e5 * metres).round() / 100.0);
            format!("Motor {motor}: x = {x} mm, y = {y} mm, its propeller turns {turns} seen from above.")
        }));
        let is_sampled = info.training.as_ref().is_some_and(|training| training.contains("randomization.airframe"));
        if let Some(ActionType::Rpm | ActionType::OneDRpm) = action_type.filter(|_| !is_sampled) {
            let (hover, max) = (drone.hover_rpm().round(), drone.max_rpm().round());
            notes.push(format!("Actions -1, 0 and 1 are 0, {hover} and {max} rpm, and linear between them."));
        }
    }
    notes
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use aviary::drone::{DroneModel, DroneParams, MotorParams};
    use aviary::env::{DroneEnv as _, Env as _, EnvConfig};
    use aviary::tasks;

    use super::*;

    fn info(task: &str, action_type: ActionType, num_drones: usize) -> PolicyInfo {
        PolicyInfo { num_drones, action_type: action_type.to_string(), ..PolicyInfo::of_task(task) }
    }

    /// M1 at the front right of a Crazyflie, and M3 diagonally opposite, turn counterclockwise. Those of the airframes
    /// with the paper's yaw convention turn against them.
    #[test]
    fn notes_have_the_motors_of_the_airframe() {
        let info = info("hover", ActionType::Rpm, 1);
        for (model, front_right) in [(DroneModel::Cf21, "counterclockwise"), (DroneModel::Cf2x, "clockwise")] {
            let drone = model.params();
            let notes = notes(&info, Some(&drone));
            let at = |x: &str, y: &str| {
                notes
                    .iter()
                    .find(|note| note.contains(&format!("x = {x}")) && note.contains(&format!("y = {y}")))
                    .unwrap()
            };
            let side = format!("{}", (1e5 * drone.motor_positions()[0][0].abs()).round() / 100.0);
            let motor = at(&side, &format!("-{side}"));
            assert!(motor.contains(&format!("turns {front_right} seen")), "{model}: {notes:?}");
            assert_ne!(motor.contains("counterclockwise"), at(&side, &side).contains("counterclockwise"));
            let hover = drone.hover_rpm().round();
            assert!(notes.last().unwrap().contains(&format!("are 0, {hover} and")), "{notes:?}");
        }
        assert_eq!(notes(&info, None).len(), 2);
        let sampled = PolicyInfo { training: Some("[randomization.airframe]".into()), ..info };
        assert!(!notes(&sampled, Some(&DroneModel::Cf2x.params())).iter().any(|note| note.contains("rpm")));
    }

    /// The list of entries follows the environments: a task or action type without names fails here.
    #[test]
    fn every_entry_of_every_task_and_action_type_has_a_name() {
        let motors = MotorParams { speed_per_volt: 6000.0, voltage: 3.7, ..MotorParams::default() };
        let params = DroneParams { motors, ..DroneModel::Cf2x.params() };
        for task in tasks::NAMES {
            for action_type in ActionType::ALL {
                let config = EnvConfig::default().drone(params.clone()).action_type(action_type);
                let env = tasks::make(task, config).unwrap();
                let info = info(task, action_type, env.simulation().num_drones());
                let seen = observation(&info, env.observation_space().vector.size());
                let acted = action(&info, env.action_space().size());
                for entries in [seen, acted] {
                    let names: HashSet<_> = entries.iter().map(|entry| &entry.name).collect();
                    assert_eq!(names.len(), entries.len(), "{task} {action_type}");
                    assert!(entries.iter().all(|entry| !entry.description.is_empty()), "{task} {action_type}");
                }
            }
        }
    }

    #[test]
    fn races_through_frames_have_named_normals() {
        let of = |drones: usize| observation(&info("race", ActionType::Rpm, drones), 27 * drones);
        assert_eq!((of(1)[21].name.as_str(), of(1)[26].name.as_str()), ("GATE_NORMAL_X", "GATE_AFTER_NORMAL_Z"));
        assert_eq!(of(2)[53].name, "DRONE1_GATE_AFTER_NORMAL_Z");
    }

    #[test]
    fn huge_numbers_of_drones_have_numbered_entries() {
        for drones in [1 << 40, usize::MAX] {
            for task in ["hover", "race"] {
                let info = info(task, ActionType::Rpm, drones);
                assert_eq!(observation(&info, 12)[11].name, "ENTRY11");
                assert_eq!(action(&info, 4)[3].name, "ENTRY3");
            }
        }
    }

    #[test]
    fn unknown_tasks_have_numbered_entries() {
        let mut info = info("hover", ActionType::Rpm, 1);
        assert_eq!(observation(&info, 13)[12].name, "ENTRY12");
        info.task = "my_task".into();
        info.action_type = "my_type".into();
        assert_eq!((observation(&info, 2)[1].name.as_str(), action(&info, 3).len()), ("ENTRY1", 3));
    }
}
