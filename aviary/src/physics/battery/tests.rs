use proptest::prelude::*;

use super::*;
use crate::drone::{BatteryParams, DroneModel, MotorParams};
use crate::math::{LANES, Pack, Row};

const DT: f64 = 1.0 / 48.0;

fn params(battery: BatteryParams) -> DroneParams {
    let motors = MotorParams { speed_at_zero: 2000.0, speed_per_volt: 5500.0, ..MotorParams::default() };
    // the reaction torque of measured propellers is a quarter of the paper's
    let torque_coefficient = 1.9e-12;
    let params = DroneParams { motors, torque_coefficient, battery: Some(battery), ..DroneModel::Cf2x.params() };
    params.validate().unwrap();
    params
}

/// One cell of a Crazyflie.
fn cell() -> BatteryParams {
    BatteryParams { capacity: 0.25, resistance: 0.1, efficiency: 0.35, idle_current: 0.15, ..BatteryParams::default() }
}

fn battery(params: &DroneParams) -> Battery {
    Battery::of(params).unwrap()
}

/// Electric power of four motors, W, by hand.
fn power(params: &DroneParams, rpm: f64) -> f64 {
    let omega = rpm * std::f64::consts::PI / 30.0;
    4.0 * params.torque_coefficient * rpm * rpm * omega / params.battery.unwrap().efficiency
}

#[test]
fn a_constant_current_empties_the_battery_linearly() {
    let params = params(cell());
    let battery = battery(&params);
    let mut state = battery.at_rest(0.9, &[0.0; 4]);
    for step in 1..=10_000 {
        let before = state.charge;
        state = battery.advance(DT, &state, &[0.0; 4]);
        let charge = 0.9 - 0.15 * f64::from(step) * DT / (3600.0 * 0.25);
        assert!((state.charge - charge).abs() < 1e-12 && state.current == 0.15);
        let open = cell().open_circuit_voltage(before);
        assert!((state.voltage - (open - 0.1 * 0.15)).abs() < 1e-14);
    }
}

#[test]
fn constant_speeds_approach_the_stationary_voltage() {
    // a capacity so large that the charge stays the same
    let params = params(BatteryParams { capacity: 1e6, ..cell() });
    let battery = battery(&params);
    for (rpm, steps) in [(10_000.0, 12), (14_500.0, 25), (19_000.0, 70)] {
        let power = power(&params, rpm);
        let open = cell().open_circuit_voltage(0.7) - 0.1 * 0.15;
        let stationary = 0.5 * (open + (open * open - 0.4 * power).sqrt());
        let mut state = battery.at_rest(0.7, &[rpm; 4]);
        assert!((state.voltage - stationary).abs() < 1e-12, "{rpm}");
        for start in [0.6, 1.3] {
            state = BatteryState { charge: 0.7, voltage: stationary * start, current: 0.0 };
            let mut error = f64::INFINITY;
            for _ in 0..steps {
                state = battery.advance(DT, &state, &[rpm; 4]);
                let next = (state.voltage - stationary).abs();
                assert!(next <= error.max(1e-8), "{rpm}: the error grew from {error} to {next}");
                error = next;
            }
            assert!(error < 1e-6, "{rpm}: {error}");
        }
        // conservation of energy: in the battery, and in the motors
        let mut before = state;
        for _ in 0..200 {
            before = state;
            state = battery.advance(DT, &state, &[rpm; 4]);
        }
        let (open, current) = (cell().open_circuit_voltage(before.charge), state.current);
        assert!((open * current - 0.1 * current * current - state.voltage * current).abs() < 1e-12, "{rpm}");
        assert!((state.voltage * (state.current - 0.15) - power).abs() < 1e-9 * power, "{rpm}");
    }
}

#[test]
fn motors_at_full_duty_do_not_oscillate() {
    for resistance in [0.05, 0.3, 1.0, 10.0] {
        let params = params(BatteryParams { capacity: 1e6, resistance, idle_current: 0.0, ..cell() });
        let battery = battery(&params);
        let mut state = battery.at_rest(1.0, &[0.0; 4]);
        let (mut speeds, mut charge) = (Vec::new(), 1.0);
        for _ in 0..60 {
            charge = state.charge;
            let speed = battery.reach(state.voltage);
            speeds.push(speed);
            state = battery.advance(DT, &state, &[speed; 4]);
        }
        let (last, early) = (speeds[59], speeds[15]);
        assert!((early - last).abs() < 1e-3 * last, "{resistance} Ω: {speeds:?}");
        let stationary = params.motors.speed(1.0, state.voltage);
        assert!((last - stationary).abs() < 1e-6 * last);
        let sag = cell().open_circuit_voltage(charge) - state.voltage;
        assert!((sag - resistance * state.current).abs() < 1e-12);
    }
}

/// ∫ V dq over the charge is the energy that hover consumes.
#[test]
fn the_hover_time_is_the_energy_over_the_power() {
    let params = params(BatteryParams { resistance: 0.0, idle_current: 0.0, ..cell() });
    let (battery, rpm) = (battery(&params), params.hover_rpm());
    let energy = 0.25 * 3600.0 * (3.685 + 0.2156 / 2.0 - 0.1178 / 3.0 + 0.3201 / 4.0 - 1.031 / 35.0);
    let seconds = energy / power(&params, rpm);
    assert!((300.0..900.0).contains(&seconds), "a Crazyflie hovers for several minutes, not {seconds} s");
    let mut state = battery.at_rest(1.0, &[rpm; 4]);
    let mut steps = 0;
    while state.charge > 0.0 {
        state = battery.advance(DT, &state, &[rpm; 4]);
        steps += 1;
    }
    assert!((f64::from(steps) * DT / seconds - 1.0).abs() < 2e-4, "{} s, expected {seconds} s", f64::from(steps) * DT);
    // nothing is left
    let empty = battery.advance(DT, &state, &[rpm; 4]);
    assert_eq!(empty, BatteryState { charge: 0.0, voltage: 0.0, current: 0.0 });
    assert_eq!(battery.reach(empty.voltage), 0.0);
}

fn batteries() -> impl Strategy<Value = BatteryParams> {
    (-3.0..2.0, 1..12_u32, 0.0..2.0, 0.05..1.0, 0.0..0.3, 0.0..=1.0).prop_map(
        |(capacity, cells, resistance, efficiency, idle_current, initial_charge)| BatteryParams {
            capacity: 10_f64.powf(capacity),
            cells,
            resistance,
            efficiency,
            idle_current,
            initial_charge,
        },
    )
}

proptest! {
    #[test]
    fn the_charge_decreases_by_the_integral_of_the_current_and_no_number_leaves_its_range(
        own in batteries(), dt in 1e-3..0.5,
        speeds in prop::collection::vec((prop::array::uniform4(0.0..30_000.0), 0..20_u32), 1..60),
    ) {
        let params = params(own);
        let battery = battery(&params);
        let mut state = battery.at_rest(own.initial_charge, &speeds[0].0);
        let mut drawn = 0.0;
        for (mut rpm, absurd) in speeds {
            if absurd == 0 {
                rpm[2] = 1e120;
            }
            let before = state;
            state = battery.advance(dt, &state, &rpm);
            prop_assert!(state.is_valid(), "{state:?} after {before:?} at {rpm:?}");
            prop_assert!(state.voltage <= own.open_circuit_voltage(before.charge));
            if before.charge > 0.0 {
                // Ohm's law
                let sag = own.open_circuit_voltage(before.charge) - state.voltage;
                prop_assert!((sag - own.resistance * state.current).abs() < 1e-9 * (1.0 + sag));
            }
            drawn += state.current * dt;
            if state.charge > 0.0 {
                let charge = own.initial_charge - drawn / (3600.0 * own.capacity);
                prop_assert!((state.charge - charge).abs() < 1e-10);
            }
        }
    }

    #[test]
    fn duty_and_speed_are_inverse(at_zero in -5e3..5e3, per_volt in 1e3..1e4, voltage in 2.0..50.0, duty in 0.0..=1.0) {
        let motors = MotorParams { speed_at_zero: at_zero, speed_per_volt: per_volt, ..MotorParams::default() };
        let rpm = motors.speed(duty, voltage);
        if rpm > 0.0 {
            prop_assert!((motors.duty(rpm, voltage) - duty).abs() < 1e-9);
        }
        prop_assert!((motors.speed(motors.duty(rpm, voltage), voltage) - rpm).abs() < 1e-9 * (1.0 + rpm));
        // beyond the reach of the voltage
        prop_assert_eq!(motors.duty(motors.speed(1.0, voltage) + 1.0, voltage), 1.0);
    }

    #[test]
    fn lanes_are_bit_identical_to_single_batteries(
        own in prop::collection::vec(prop::option::of(batteries()), LANES), dt in 1e-3..0.1,
        speeds in prop::collection::vec(prop::array::uniform4(0.0..25_000.0), 4 * LANES),
    ) {
        let own: Vec<_> = own.into_iter().map(|own| own.map(params)).collect();
        let singles: Vec<_> = own.iter().map(|own| own.as_ref().map(battery)).collect();
        let mut lanes = BatteryLanes::default();
        let mut states = [BatteryState::default(); LANES];
        for lane in 0..LANES {
            let Some(single) = &singles[lane] else { continue };
            let charge = own[lane].as_ref().and_then(|own| own.battery).unwrap().initial_charge;
            states[lane] = single.at_rest(charge, &speeds[lane]);
            lanes.set(lane, single, &states[lane]);
        }
        for rows in speeds.chunks_exact(LANES) {
            let rpm: [Row; 4] = std::array::from_fn(|motor| std::array::from_fn(|lane| rows[lane][motor]));
            let before = lanes.clone();
            advance_all(&mut lanes, dt, &rpm);
            // the last lane stays behind
            let mut flew = [true; LANES];
            flew[LANES - 1] = false;
            lanes.keep(&before, &flew);
            for lane in 0..LANES {
                if let Some(single) = singles[lane].as_ref().filter(|_| flew[lane]) {
                    states[lane] = single.advance(dt, &states[lane], &rows[lane]);
                }
                prop_assert_eq!(lanes.state(lane), singles[lane].map(|_| states[lane]));
            }
        }
        lanes.clear(0);
        prop_assert_eq!(lanes.state(0), None);
    }
}

fn advance_all(lanes: &mut BatteryLanes, dt: f64, rpm: &[Row; 4]) {
    struct All<'a>(&'a mut BatteryLanes, f64, &'a [Row; 4]);
    impl pulp::WithSimd for All<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, simd: S) {
            let Self(lanes, dt, rpm) = self;
            for index in 0..LANES / S::F64_LANES {
                let [a, b, c, d] = rpm;
                let speeds = [a, b, c, d].map(|row| Pack::load(simd, row, index));
                lanes.advance(simd, index, dt, &speeds);
            }
        }
    }
    pulp::Arch::new().dispatch(All(lanes, dt, rpm));
}
