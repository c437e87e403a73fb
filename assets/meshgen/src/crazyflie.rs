//! The Crazyflie 2.x: a 92 mm nano quadrotor whose circuit board is its frame.
//!
//! Dimensions are the vehicle's nominal ones, in metres. Parts are grouped by material and match the `cf2_*`
//! numbering of the MuJoCo Menagerie model, so that both sets of meshes fit the same MJCF.

use crate::mesh::{
    CREASE, Part, Point2, bevelled_prism, block, circle, lathe, loft, prism, rectangle, rounded_rectangle, tube,
};
use crate::propeller::{Propeller, Spin, Station};
use crate::vec3::{Vec3, vec3};
use std::f64::consts::{FRAC_1_SQRT_2, FRAC_PI_4};

/// Distance of each motor from the centre along x and along y.
pub const MOTOR_XY: f64 = 0.0325;
/// Distance of each motor's axis from the centre.
const ARM: f64 = MOTOR_XY / FRAC_1_SQRT_2;
/// Radius swept by a propeller.
pub const PROP_RADIUS: f64 = 0.02325;
/// Underside and top of the circuit board.
const BOARD: [f64; 2] = [-0.0008, 0.0008];
/// Half the side of the board's central square.
const BOARD_HALF: f64 = 0.0148;
/// Half the width of a board arm near the motor.
const ARM_HALF: f64 = 0.0033;
/// Underside and top of the battery.
const BATTERY: [f64; 2] = [0.0042, 0.0111];
/// Underside and top of the battery holder board.
const HOLDER: [f64; 2] = [0.0111, 0.0121];
/// Distance of the header rows from the centre line.
const HEADER_Y: f64 = 0.0115;
/// Distance between the pins of a row.
const PIN_PITCH: f64 = 0.002;
/// Pins in a row.
const PINS: usize = 10;
/// Bottom and top of the motors.
const MOTOR: [f64; 2] = [-0.0054, 0.0112];
/// Motor radius.
const MOTOR_RADIUS: f64 = 0.0035;
/// Tip of the landing legs and top of the motor mounts.
const MOUNT: [f64; 2] = [-0.0125, 0.0048];
/// Outer radius of the sleeve that holds a motor.
const SLEEVE_RADIUS: f64 = 0.0043;
/// Underside and top of the propellers' hubs.
const PROP: [f64; 2] = [0.0112, 0.0147];

/// Returns the visual parts in file order, each with its description.
pub fn visual() -> Vec<(&'static str, Part)> {
    vec![
        ("propellers", propellers()),
        ("deck and surface-mounted electronics", electronics()),
        ("header pins", pins()),
        ("battery", battery()),
        ("motors", motors()),
        ("circuit board frame and battery holder", frame()),
        ("motor mounts with landing legs", mounts()),
    ]
}

/// Returns the convex collision pieces in file order, each with its description.
pub fn collision() -> Vec<(&'static str, Part)> {
    let octagon = rounded_rectangle(BOARD_HALF, BOARD_HALF, 0.004, 1);
    let mut pieces = vec![("body hull", Part::new([prism(&octagon, BOARD[0], HOLDER[1])]))];
    let arm = block(vec3(0.029, 0.0, BOARD[0]), vec3(0.028, 2.0 * ARM_HALF, BOARD[1] - BOARD[0]));
    let motor = prism(&circle(SLEEVE_RADIUS, 8), MOUNT[0], MOTOR[1]).at(ARM, 0.0, 0.0);
    let rotor = prism(&circle(PROP_RADIUS, 12), PROP[0], PROP[1]).at(ARM, 0.0, 0.0);
    for (name, solid) in [("arm hull", arm), ("motor hull", motor), ("rotor hull", rotor)] {
        for heading in headings() {
            let turned = solid.clone().moved(|p| p.rotated_z(heading));
            pieces.push((name, Part::new([turned])));
        }
    }
    pieces
}

/// Returns the directions of the arms from x, radians: front left, back left, back right, front right.
fn headings() -> [f64; 4] {
    [1.0, 3.0, 5.0, 7.0].map(|eighth| eighth * FRAC_PI_4)
}

/// Returns copies of `part`, which is modelled on an arm along +x, on every arm.
fn on_each_arm(part: &Part) -> Part {
    let mut all = Part::default();
    for heading in headings() {
        all.append(part.clone().moved(|p| p.rotated_z(heading)));
    }
    all
}

/// Four two-blade propellers; neighbours turn in opposite directions.
fn propellers() -> Part {
    let station = |radius: f64, chord: f64, lead: f64| Station { radius, chord, lead };
    let propeller = Propeller {
        blades: 2,
        stations: &[
            station(0.0016, 0.0030, 0.0),
            station(0.0052, 0.0048, 0.0002),
            station(0.0092, 0.0066, 0.0004),
            station(0.0135, 0.0070, 0.0003),
            station(0.0185, 0.0058, -0.0001),
            station(0.0221, 0.0037, -0.0006),
            station(PROP_RADIUS - 0.0001, 0.0012, -0.0011),
        ],
        pitch: 0.022,
        thickness: 0.0006,
        height: 0.0129,
        hub: &[[0.0024, PROP[0]], [0.0022, 0.0138], [0.0011, PROP[1]]],
        hub_segments: 8,
        hub_crease: 50.0,
    };
    // Each at a different angle, as after landing.
    let rest = [0.35, -0.25, 1.1, -0.75];
    let mut all = Part::default();
    for (index, heading) in headings().into_iter().enumerate() {
        // Counter-clockwise at the front left: motor 0 turns the nose to the right, and the reaction torque on the
        // airframe is opposite to the propeller's rotation.
        let spin = if index % 2 == 0 { Spin::Ccw } else { Spin::Cw };
        let axis = vec3(ARM, 0.0, 0.0).rotated_z(heading);
        all.append(propeller.build(spin, heading + rest[index]).moved(|p| p + axis));
    }
    all
}

/// A small deck on the battery holder, and the visible chips and sockets on the board around the battery.
fn electronics() -> Part {
    let deck_top = HOLDER[1] + 0.0008;
    let chip = |x: f64, y: f64, z: f64, size: [f64; 3]| block(vec3(x, y, z), vec3(size[0], size[1], size[2]));
    Part::new([
        bevelled_prism(&rounded_rectangle(0.0042, 0.0070, 0.0008, 1), HOLDER[1], deck_top, 0.0002),
        chip(0.0, 0.0014, deck_top, [0.0044, 0.0036, 0.0009]),
        chip(0.0008, -0.0036, deck_top, [0.0026, 0.0026, 0.0006]),
        // Below the ends of the battery: processor, radio, USB socket, switch.
        chip(0.0086, 0.0030, BOARD[1], [0.0070, 0.0070, 0.0010]),
        chip(0.0090, -0.0050, BOARD[1], [0.0050, 0.0050, 0.0009]),
        chip(-0.0120, 0.0, BOARD[1], [0.0052, 0.0076, 0.0026]),
        chip(-0.0112, 0.0074, BOARD[1], [0.0036, 0.0026, 0.0020]),
        chip(0.0132, -0.0090, BOARD[1], [0.0020, 0.0016, 0.0008]),
        chip(0.0134, 0.0092, BOARD[1], [0.0016, 0.0022, 0.0008]),
    ])
}

/// Two rows of header pins along x, and the solder pads of the motor leads.
fn pins() -> Part {
    let mut part = Part::default();
    for side in [1.0, -1.0] {
        for pin in 0..PINS {
            let x = (pin as f64 - (PINS - 1) as f64 / 2.0) * PIN_PITCH;
            part.push(block(vec3(x, side * HEADER_Y, 0.0005), vec3(0.0005, 0.0005, 0.018)));
        }
    }
    let pad = |y: f64| block(vec3(0.0262, y, 0.0006), vec3(0.0022, 0.0014, 0.00035));
    part.append(on_each_arm(&Part::new([pad(0.0012), pad(-0.0012)])));
    part
}

/// Pouch cell, lengthways, with its protection board at the front.
fn battery() -> Part {
    let height = BATTERY[1] - BATTERY[0];
    let middle = (BATTERY[0] + BATTERY[1]) / 2.0;
    let ring = |x: f64, shrink: f64| -> Vec<Vec3> {
        rounded_rectangle(0.0100 - shrink, height / 2.0 - shrink, 0.0022 - shrink, 2)
            .into_iter()
            .map(|p| vec3(x, p[0], middle + p[1]))
            .collect()
    };
    Part::new([
        loft(&[ring(-0.0150, 0.0010), ring(-0.0143, 0.0), ring(0.0128, 0.0), ring(0.0134, 0.0008)], 55.0),
        block(vec3(0.0141, 0.0, middle - 0.0012), vec3(0.0018, 0.0164, 0.0024)),
    ])
}

/// Four coreless motors.
fn motors() -> Part {
    let motor = lathe(
        &[[MOTOR_RADIUS, MOTOR[0]], [MOTOR_RADIUS, 0.0099], [0.0029, 0.0104], [0.0010, 0.0104], [0.0009, MOTOR[1]]],
        12,
        CREASE,
    );
    on_each_arm(&Part::new([motor.at(ARM, 0.0, 0.0)]))
}

/// Outline of the circuit board: a square with a fillet to each of the four arms.
fn board_outline() -> Vec<Point2> {
    /// Facets of each fillet between square and arm.
    const STEPS: usize = 4;
    let reach = ARM - MOTOR_RADIUS + 0.001;
    let flare = 0.0262;
    // The arm along +x, rotated later: its right flank from the square outwards.
    let corner = vec3(BOARD_HALF, 0.0062, 0.0).rotated_z(-FRAC_PI_4);
    // Intersection of the square's side with the flank.
    let along = BOARD_HALF / FRAC_1_SQRT_2 - ARM_HALF;
    let mut flank: Vec<Point2> = (0..=STEPS)
        .map(|step| {
            let t = step as f64 / STEPS as f64;
            let blend = |a: f64, b: f64, c: f64| a * (1.0 - t) * (1.0 - t) + 2.0 * b * t * (1.0 - t) + c * t * t;
            [blend(corner.x, along, flare), blend(corner.y, -ARM_HALF, -ARM_HALF)]
        })
        .collect();
    flank.push([reach, -ARM_HALF]);
    let mirrored: Vec<Point2> = flank.iter().rev().map(|p| [p[0], -p[1]]).collect();
    flank.extend(mirrored);
    headings()
        .iter()
        .flat_map(|heading| {
            flank.iter().map(|p| {
                let turned = vec3(p[0], p[1], 0.0).rotated_z(*heading);
                [turned.x, turned.y]
            })
        })
        .collect()
}

/// Circuit board with header strips, pad under the battery, holder above it, and the leads of battery and motors.
fn frame() -> Part {
    let mut part = Part::new([
        prism(&board_outline(), BOARD[0], BOARD[1]),
        block(vec3(-0.001, 0.0, BOARD[1]), vec3(0.012, 0.016, BATTERY[0] - BOARD[1])),
        prism(&holder_outline(), HOLDER[0], HOLDER[1]),
    ]);
    let strip_half = PINS as f64 * PIN_PITCH / 2.0;
    for side in [1.0, -1.0] {
        // The sockets on the board and the spacers under the holder.
        let strip = bevelled_prism(&rectangle(strip_half, 0.00105), BOARD[1], 0.0050, 0.0002);
        part.push(strip.at(0.0, side * HEADER_Y, 0.0));
        let spacer = block(vec3(0.0, side * HEADER_Y, 0.0095), vec3(2.0 * strip_half, 0.0021, HOLDER[0] - 0.0095));
        part.push(spacer);
        part.push(tube(
            &[
                vec3(-0.0140, side * 0.0011, 0.0090),
                vec3(-0.0168, side * 0.0012, 0.0080),
                vec3(-0.0170, side * 0.0014, 0.0048),
                vec3(-0.0140, side * 0.0016, 0.0028),
            ],
            vec3(0.0, 1.0, 0.0),
            0.0005,
            5,
        ));
    }
    let plug = block(vec3(0.0240, 0.0, BOARD[1]), vec3(0.0030, 0.0044, 0.0014));
    part.append(on_each_arm(&Part::new([plug])));
    part
}

/// Outline of the battery holder board: a rail over each header row and a bridge across the battery.
fn holder_outline() -> Vec<Point2> {
    let (end, outer, inner, bridge) = (0.0110, 0.0135, 0.0090, 0.0052);
    let quarter: [Point2; 6] = [
        [bridge, 0.0],
        [bridge, inner - 0.0015],
        [bridge + 0.0015, inner],
        [end, inner],
        [end, outer - 0.0010],
        [end - 0.0010, outer],
    ];
    let mirror = |sx: f64, sy: f64| quarter.map(|p| [sx * p[0], sy * p[1]]);
    let mut outline = mirror(1.0, 1.0).to_vec();
    let mut back_left = mirror(-1.0, 1.0);
    back_left.reverse();
    outline.extend(back_left);
    outline.extend(&mirror(-1.0, -1.0)[1..]);
    let mut front_right = mirror(1.0, -1.0);
    front_right.reverse();
    outline.extend(&front_right[..quarter.len() - 1]);
    outline
}

/// Four sleeves that hold the motors and clip on to the arms, each on a leg.
fn mounts() -> Part {
    let sleeve = lathe(&[[SLEEVE_RADIUS, -0.0062], [SLEEVE_RADIUS, MOUNT[1]]], 12, CREASE).at(ARM, 0.0, 0.0);
    let inner = ARM - 0.0105;
    let clip: Vec<Point2> = vec![
        [inner, -0.0034],
        [inner + 0.0012, -0.0042],
        [ARM - 0.001, -0.0043],
        [ARM - 0.001, 0.0043],
        [inner + 0.0012, 0.0042],
        [inner, 0.0034],
    ];
    let leg_ring = |x: f64, z: f64, hx: f64, hy: f64| -> Vec<Vec3> {
        // From the top down, so that the ring runs clockwise seen from above.
        rectangle(hx, hy).into_iter().rev().map(|p| vec3(ARM + x + p[0], p[1], z)).collect()
    };
    let leg = loft(
        &[
            leg_ring(-0.0012, -0.0060, 0.0030, 0.0016),
            leg_ring(0.0004, -0.0095, 0.0018, 0.0013),
            leg_ring(0.0012, MOUNT[0], 0.0010, 0.0007),
        ],
        CREASE,
    );
    let brace_ring = |x: f64, z: f64| -> Vec<Vec3> {
        // From the top down, as above.
        [(x, -0.0006), (x, 0.0006), (ARM, 0.0006), (ARM, -0.0006)].into_iter().map(|(x, y)| vec3(x, y, z)).collect()
    };
    // The brace between leg and arm.
    let brace = loft(&[brace_ring(inner + 0.001, -0.0022), brace_ring(ARM - 0.0044, -0.0066)], CREASE);
    on_each_arm(&Part::new([sleeve, prism(&clip, -0.0024, 0.0026), leg, brace]))
}
