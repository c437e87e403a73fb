//! A custom airframe: a Crazyflie with a camera, from its TOML file to derived quantities, a flight and an image.
//!
//! `cargo run --release --example custom_airframe -- [DIRECTORY] [SECONDS]` writes `courier.toml` (for `aviary fly
//! --drone`), `courier.png` and `flight.svg`. Defaults: directory `out/custom_airframe`, 8 s.

use mujoco_drones_gym::prelude::*;
use mujoco_drones_gym::record::Flight;
use mujoco_drones_gym::record::images::png_rgb;
use mujoco_drones_gym::record::plot::Plot;

const COURIER: &str = r#"
name = "courier"
mass = 0.039                         # kg: 12 g more than a Crazyflie
inertia = [2.1e-5, 2.3e-5, 3.4e-5]   # kg m²
arm_length = 0.055                   # m
layout = "x"
yaw_convention = "crazyflie"
thrust_coefficient = 4.9e-10         # N / rpm²
torque_coefficient = 1.2e-11         # N m / rpm²
thrust_to_weight = 1.9
propeller_radius = 0.0275            # m
ground_effect_coefficient = 11.36859
drag_coefficients = [1.2e-6, 1.2e-6, 1.4e-6]  # N / (m/s) / (rad/s)
downwash_coefficients = [2267.18, 0.16, -0.11]
collision_radius = 0.085             # m
collision_height = 0.04              # m
max_speed = 6.0                      # m/s
appearance = "crazyflie"
provenance = "example values without measurements"
"#;

#[allow(clippy::print_stdout)]
fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let directory = std::path::PathBuf::from(arguments.next().unwrap_or_else(|| "out/custom_airframe".into()));
    let seconds: f64 = arguments.next().map_or(Ok(8.0), |text| text.parse())?;
    std::fs::create_dir_all(&directory)?;
    std::fs::write(directory.join("courier.toml"), COURIER)?;

    let courier = DroneParams::from_file(directory.join("courier.toml"))?;
    println!("hover speed {:.0} rpm, maximum {:.0} rpm", courier.hover_rpm(), courier.max_rpm());
    let mut env = Hover::builder().drone(courier).physics(Physics::MjcGndDragDw).episode_seconds(seconds).build()?;
    // controllers scale their gains with the inertia
    let mut pilot = ControllerPolicy::new(ControllerKind::Dsl, &env);
    let mut flight = Flight::default();
    let mut rollout = Rollout::start(&mut env, &mut pilot, Some(1))?;
    flight.note(rollout.env());
    rollout.finish(|env| flight.note(env))?;
    let size = ImageSize { width: 640, height: 480 };
    let mut rgb = vec![0; 3 * size.pixels()];
    env.render(View::Track, size, &mut rgb)?;
    std::fs::write(directory.join("courier.png"), png_rgb(size, &rgb)?)?;
    Plot::of_flight("A courier takes off", &flight)?.save(directory.join("flight.svg"))?;
    for name in ["courier.toml", "courier.png", "flight.svg"] {
        println!("{}", directory.join(name).display());
    }
    println!("{:.2} cm position error after {seconds} s", 100.0 * env.info().position_error);
    Ok(())
}
