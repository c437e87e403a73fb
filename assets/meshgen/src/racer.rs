//! A 250 mm racing quadrotor: carbon plates, 5-inch three-blade propellers.
//!
//! Dimensions in metres. Body and rotor hubs fit a cylinder of 150 mm radius and 60 mm height about the origin;
//! only the antenna extends beyond it.

use crate::mesh::{
    CREASE, Part, Point2, Solid, bevelled_prism, block, circle, lathe, loft, prism, rectangle, rounded_rectangle, tube,
};
use crate::propeller::{Propeller, Spin, Station};
use crate::vec3::{Vec3, vec3};
use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};

/// Distance of each motor's axis from the centre, on the diagonals.
pub const ARM: f64 = 0.125;
/// Radius swept by a propeller.
pub const PROP_RADIUS: f64 = 0.0635;
/// Underside and top of the arms.
const ARM_PLATE: [f64; 2] = [-0.0275, -0.0230];
/// Underside and top of the bottom plate.
const BOTTOM_PLATE: [f64; 2] = [-0.0230, -0.0210];
/// Underside and top of the top plate.
const TOP_PLATE: [f64; 2] = [-0.0010, 0.0010];
/// Underside and top of the battery.
const BATTERY: [f64; 2] = [0.0018, 0.0288];
/// Half length and half width of the battery.
const BATTERY_HALF: [f64; 2] = [0.0365, 0.0165];
/// Radius of the motors' bells.
const BELL_RADIUS: f64 = 0.0140;
/// Top of the motors' bells.
const BELL_TOP: f64 = -0.0040;
/// Underside and top of the propellers' hubs.
const PROP: [f64; 2] = [BELL_TOP, 0.0040];
/// Top of the propeller nuts.
const NUT_TOP: f64 = 0.0095;
/// Upward tilt of the camera, radians.
const CAMERA_TILT: f64 = 0.5;
/// Centre of the camera.
const CAMERA: Vec3 = vec3(0.0600, 0.0, -0.0100);
/// Positions of the standoffs with y > 0.
const STANDOFFS: [Point2; 4] = [[0.0690, 0.0165], [0.0290, 0.0205], [-0.0290, 0.0205], [-0.0620, 0.0165]];

/// Returns the visual parts in file order, each with its description.
pub fn visual() -> Vec<(&'static str, Part)> {
    vec![
        ("propellers", propellers()),
        ("carbon frame", frame()),
        ("motors", motors()),
        ("battery", battery()),
        ("flight stack", stack()),
        ("camera", camera()),
        ("standoffs, antenna and other accents", accents()),
    ]
}

/// Returns the convex collision pieces in file order, each with its description.
pub fn collision() -> Vec<(&'static str, Part)> {
    let body = prism(&rounded_rectangle(0.0740, 0.0230, 0.0080, 1), ARM_PLATE[0], TOP_PLATE[1]);
    let pack = prism(&rectangle(BATTERY_HALF[0], BATTERY_HALF[1]), TOP_PLATE[1], BATTERY[1]);
    let arm = block(vec3(0.0720, 0.0, ARM_PLATE[0]), vec3(0.0960, 0.0140, ARM_PLATE[1] - ARM_PLATE[0]));
    let motor = prism(&circle(0.0155, 8), ARM_PLATE[0], BELL_TOP).at(ARM, 0.0, 0.0);
    let rotor = prism(&circle(PROP_RADIUS, 12), PROP[0], NUT_TOP).at(ARM, 0.0, 0.0);
    let mut pieces = vec![("body hull", Part::new([body])), ("battery hull", Part::new([pack]))];
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

/// Four three-blade propellers; neighbours turn in opposite directions.
fn propellers() -> Part {
    let station = |radius: f64, chord: f64, lead: f64| Station { radius, chord, lead };
    let propeller = Propeller {
        blades: 3,
        stations: &[
            station(0.0050, 0.0080, 0.0),
            station(0.0140, 0.0110, 0.0010),
            station(0.0270, 0.0150, 0.0020),
            station(0.0410, 0.0140, 0.0012),
            station(0.0540, 0.0105, -0.0008),
            station(0.0612, 0.0070, -0.0028),
            station(PROP_RADIUS - 0.0003, 0.0032, -0.0042),
        ],
        pitch: 0.100,
        thickness: 0.0016,
        height: 0.0005,
        hub: &[[0.0062, PROP[0]], [0.0066, 0.0030], [0.0055, PROP[1]]],
        hub_segments: 10,
        hub_crease: 38.0,
    };
    let rest = [0.3, 1.0, -0.45, 0.75];
    let mut all = Part::default();
    for (index, heading) in headings().into_iter().enumerate() {
        // Clockwise at the front left: the directions are opposite to the Crazyflie's.
        let spin = if index % 2 == 0 { Spin::Cw } else { Spin::Ccw };
        let axis = vec3(ARM, 0.0, 0.0).rotated_z(heading);
        all.append(propeller.build(spin, heading + rest[index]).moved(|p| p + axis));
    }
    all
}

/// Returns the outline of a body plate, symmetric about the x axis: `half` lists its corners for y > 0 from front
/// to back.
fn plate(half: &[Point2]) -> Vec<Point2> {
    let mirrored = half.iter().rev().map(|p| [p[0], -p[1]]);
    half.iter().copied().chain(mirrored).collect()
}

/// Arms, bottom and top plates and the camera's side plates.
fn frame() -> Part {
    let mut part = Part::new([
        prism(
            &plate(&[
                [0.0740, 0.0140],
                [0.0680, 0.0210],
                [0.0400, 0.0210],
                [0.0330, 0.0250],
                [-0.0330, 0.0250],
                [-0.0400, 0.0210],
                [-0.0660, 0.0210],
                [-0.0720, 0.0140],
            ]),
            BOTTOM_PLATE[0],
            BOTTOM_PLATE[1],
        ),
        // The top plate ends in a fork around the camera and has a waist, as lightweight frames do.
        prism(
            &plate(&[
                [0.0500, 0.0085],
                [0.0545, 0.0120],
                [0.0740, 0.0120],
                [0.0740, 0.0180],
                [0.0690, 0.0215],
                [0.0600, 0.0215],
                [0.0450, 0.0150],
                [0.0380, 0.0150],
                [0.0330, 0.0245],
                [0.0250, 0.0245],
                [0.0190, 0.0170],
                [-0.0190, 0.0170],
                [-0.0250, 0.0245],
                [-0.0330, 0.0245],
                [-0.0400, 0.0150],
                [-0.0540, 0.0150],
                [-0.0580, 0.0215],
                [-0.0660, 0.0215],
                [-0.0700, 0.0170],
            ]),
            TOP_PLATE[0],
            TOP_PLATE[1],
        ),
    ]);
    // An arm ends in a round pad under the motor.
    let pad = 0.0150;
    let mut outline: Vec<Point2> = vec![[0.0100, -0.0075], [0.0500, -0.0068], [0.1000, -0.0056]];
    for step in 0..=8 {
        let (s, c) = ((step as f64 - 4.0) * 0.55).sin_cos();
        outline.push([ARM + pad * c, pad * s]);
    }
    outline.extend([[0.1000, 0.0056], [0.0500, 0.0068], [0.0100, 0.0075]]);
    part.append(on_each_arm(&Part::new([prism(&outline, ARM_PLATE[0], ARM_PLATE[1])])));
    // Side plates of the camera, upright between bottom and top plate.
    for side in [1.0, -1.0] {
        let profile: [Point2; 6] = [
            [0.0500, BOTTOM_PLATE[1]],
            [0.0700, BOTTOM_PLATE[1]],
            [0.0760, -0.0100],
            [0.0740, 0.0010],
            [0.0600, 0.0040],
            [0.0500, -0.0040],
        ];
        let sheet = prism(&profile, -0.0010, 0.0010)
            // Rotate the sheet upright: its outline's y becomes z.
            .moved(|p| vec3(p.x, -p.z, p.y))
            .at(0.0, side * 0.0108, 0.0);
        part.push(sheet);
    }
    part
}

/// Four outrunner motors: stator base and bell with a rounded shoulder. The propeller hides the shaft.
fn motors() -> Part {
    let motor = lathe(
        &[
            [0.0110, ARM_PLATE[1]],
            [0.0100, -0.0200],
            [BELL_RADIUS, -0.0196],
            [BELL_RADIUS, -0.0066],
            [0.0120, BELL_TOP],
        ],
        12,
        CREASE,
    );
    on_each_arm(&Part::new([motor.at(ARM, 0.0, 0.0)]))
}

/// Battery pack below its strap, with lead and plug.
fn battery() -> Part {
    let pack = rounded_rectangle(BATTERY_HALF[0], BATTERY_HALF[1], 0.0030, 2);
    let mut part = Part::new([
        bevelled_prism(&pack, BATTERY[0], BATTERY[1], 0.0016),
        block(vec3(-0.0660, 0.0, 0.0030), vec3(0.0150, 0.0160, 0.0080)),
    ]);
    for side in [1.0, -1.0] {
        part.push(tube(
            &[
                vec3(-0.0350, side * 0.0050, 0.0200),
                vec3(-0.0430, side * 0.0050, 0.0195),
                vec3(-0.0500, side * 0.0045, 0.0120),
                vec3(-0.0600, side * 0.0040, 0.0070),
            ],
            vec3(0.0, 1.0, 0.0),
            0.0019,
            6,
        ));
    }
    part
}

/// Speed controller below the flight controller, with the video transmitter behind them.
fn stack() -> Part {
    let board = |z: f64| bevelled_prism(&rounded_rectangle(0.0180, 0.0180, 0.0030, 1), z, z + 0.0018, 0.0003);
    let mut part = Part::new([
        board(-0.0175),
        board(-0.0095),
        block(vec3(0.0, 0.0, -0.0157), vec3(0.0240, 0.0240, 0.0030)),
        block(vec3(0.0, 0.0, -0.0077), vec3(0.0100, 0.0100, 0.0016)),
        block(vec3(0.0, 0.0160, -0.0077), vec3(0.0090, 0.0060, 0.0032)),
        block(vec3(-0.0420, 0.0, -0.0185), vec3(0.0260, 0.0240, 0.0080)),
    ]);
    for x in [0.0152, -0.0152] {
        for y in [0.0152, -0.0152] {
            part.push(block(vec3(x, y, BOTTOM_PLATE[1]), vec3(0.0028, 0.0028, 0.0150)));
        }
    }
    part
}

/// The camera, tilted up between its side plates.
fn camera() -> Part {
    let housing = bevelled_prism(&rounded_rectangle(0.0090, 0.0092, 0.0020, 1), -0.0090, 0.0090, 0.0012);
    // The lens is revolved about z, then rotated to look along x.
    let lens =
        lathe(&[[0.0072, 0.0080], [0.0072, 0.0125], [0.0060, 0.0125], [0.0060, 0.0160], [0.0044, 0.0152]], 12, CREASE)
            .moved(|p| p.rotated_y(FRAC_PI_2));
    Part::new([housing, lens]).moved(|p| p.rotated_y(-CAMERA_TILT) + CAMERA)
}

/// Parts in the accent colour: standoffs, propeller nuts, feet, battery strap, antenna with its mount, and the tail
/// light.
fn accents() -> Part {
    let mut part = Part::default();
    for [x, y] in STANDOFFS {
        for side in [1.0, -1.0] {
            part.push(prism(&circle(0.0026, 6), BOTTOM_PLATE[1], TOP_PLATE[0]).at(x, side * y, 0.0));
        }
    }
    let nut = prism(&circle(0.0042, 6), 0.0040, NUT_TOP).at(ARM, 0.0, 0.0);
    let foot = prism(&rounded_rectangle(0.0080, 0.0080, 0.0040, 1), -0.0298, ARM_PLATE[0]).at(ARM, 0.0, 0.0);
    part.append(on_each_arm(&Part::new([nut, foot])));
    part.push(strap());
    part.push(block(vec3(-0.0735, 0.0, -0.0200), vec3(0.0030, 0.0300, 0.0045)));
    // The antenna's mount, stalk and cap.
    part.push(block(vec3(-0.0700, 0.0, BOTTOM_PLATE[1]), vec3(0.0060, 0.0140, 0.0200)));
    part.push(tube(
        &[vec3(-0.0700, 0.0, -0.0060), vec3(-0.0780, 0.0, 0.0040), vec3(-0.0860, 0.0, 0.0330)],
        vec3(0.0, 1.0, 0.0),
        0.0016,
        6,
    ));
    let cap = lathe(&[[0.0040, 0.0], [0.0075, 0.0030], [0.0075, 0.0080], [0.0045, 0.0110]], 10, 50.0)
        .moved(|p| p.rotated_y(-0.27))
        .at(-0.0855, 0.0, 0.0310);
    part.push(cap);
    part
}

/// The strap around the battery and the top plate.
fn strap() -> Solid {
    let (gap, half_width) = (0.0008, 0.0095);
    let [bottom, top] = [TOP_PLATE[0] - gap, BATTERY[1] + gap];
    let middle = (bottom + top) / 2.0;
    let outline = rounded_rectangle(BATTERY_HALF[1] + gap, (top - bottom) / 2.0, 0.0022, 2);
    let ring = |x: f64| -> Vec<Vec3> { outline.iter().map(|p| vec3(x, p[0], middle + p[1])).collect() };
    loft(&[ring(-half_width), ring(half_width)], 50.0)
}
