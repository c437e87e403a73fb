//! Physics of a block in lanes, and the check of what its drones can reach.

use std::ops::Range;

use super::conditions::ConditionSlices;
use super::shard::{BatchModel, EnvSlices, Shard};
use super::worker::{Worker, lanes_and_params};
use crate::engine::ClearanceCache;
use crate::engine::flight::{
    Extras, Flow, LANES, Lanes, advance_batteries, advance_with, compute_downwash, find_apart, find_clear,
};
use crate::env::Task;
use crate::physics::wind::WindLanes;
use crate::simulation::SimData;

impl<T: Task> Worker<T> {
    /// Returns true for the environments of a block that cannot touch anything during the control step, whatever
    /// their motors do.
    fn find_clear(
        &mut self,
        model: &BatchModel,
        flow: &Flow,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &[bool; LANES],
    ) -> [bool; LANES] {
        let (lanes, lane_params) = lanes_and_params(model, shard, range.start);
        let mut clear = find_clear(flow, lanes, lane_params, range.len(), model.substeps);
        clear.iter_mut().zip(fits_lanes).for_each(|(clear, fits)| *clear &= fits);
        self.exclude_obstacles(model, shard, range, &mut clear, |worker, data, lanes, lane, caches| {
            data.is_clear_of_obstacles(&worker.env.simulation.model, lanes, lane, caches)
        });
        clear
    }

    /// Returns true for the environments of a block that have not touched anything during the control step, from
    /// the bounds of their travel in `travels` and the states in `saved`.
    fn find_untouched(
        &mut self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &[bool; LANES],
    ) -> [bool; LANES] {
        let (_, lane_params) = lanes_and_params(model, shard, range.start);
        let mut free = find_apart(&self.saved, lane_params, &self.travels, range.len());
        free.iter_mut().zip(fits_lanes).for_each(|(free, fits)| *free &= fits);
        self.exclude_obstacles(model, shard, range, &mut free, |worker, data, _, lane, caches| {
            let travels = worker.travels.iter().map(|row| row[lane]);
            data.travels_clear_of_obstacles(&worker.env.simulation.model, &worker.saved, lane, travels, caches)
        });
        free
    }

    /// Clears the flags of environments whose drones may reach an obstacle. `is_clear` gets the worker, an
    /// environment's data, the lanes of its block, its lane, and the cached distances of its drones.
    fn exclude_obstacles(
        &self,
        model: &BatchModel,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        flags: &mut [bool; LANES],
        is_clear: impl Fn(&Self, &SimData, &[Lanes], usize, &mut [ClearanceCache]) -> bool,
    ) {
        if shard.envs.clearance_caches.is_empty() {
            return;
        }
        let drones = model.drones;
        for index in range {
            let lane = index % LANES;
            let lanes = &shard.envs.lanes[index / LANES * drones..][..drones];
            let data = shard.envs.slots[index].data.as_deref().unwrap_or(&self.env.simulation.data);
            let caches = &mut shard.envs.clearance_caches[drones * index..][..drones];
            flags[lane] = flags[lane] && is_clear(self, data, lanes, lane, caches);
        }
    }

    /// Advances the environments of a block in lanes. Returns true for those whose drones have touched nothing; the
    /// other lanes keep everything except the commands.
    pub(super) fn advance_lanes(
        &mut self,
        model: &BatchModel,
        flow: &Flow,
        shard: &mut Shard<'_, T>,
        range: Range<usize>,
        fits_lanes: &[bool; LANES],
    ) -> [bool; LANES] {
        let (start, count) = (range.start, range.len());
        let clear = self.find_clear(model, flow, shard, range.clone(), fits_lanes);
        let checked = clear != *fits_lanes;
        let drones = model.drones;
        let block_range = start / LANES * drones..(start / LANES + 1) * drones;
        let EnvSlices { lanes, lane_params, conditions, .. } = &mut shard.envs;
        let lanes = &mut lanes[block_range.clone()];
        let lane_params = if lane_params.is_empty() { &model.lane_params[..] } else { &lane_params[block_range] };
        let ConditionSlices { wind, motors, states, .. } = conditions.block(start / LANES, drones);
        for (states, record) in states.iter().zip(&mut self.records) {
            record.at = states.recorded_steps(model.substeps);
        }
        let all = !checked && fits_lanes[..count].iter().all(|fits| *fits);
        if !all {
            // the kernel advances all lanes, therefore the others are restored afterwards
            self.saved.iter_mut().zip(&*lanes).for_each(|(saved, lanes)| saved.copy_moving(lanes));
            self.saved_wind.clear();
            self.saved_wind.extend(wind.iter().map(WindLanes::moving));
            self.travels.fill([0.0; LANES]);
        }
        let mut advance = |lanes: &mut [Lanes], steps: Range<u32>| {
            for (drone, (lanes, lane_params)) in lanes.iter_mut().zip(lane_params).enumerate() {
                let mut extras = Extras {
                    wind: wind.get_mut(drone).filter(|wind| wind.is_windy()),
                    late: motors.get(drone).filter(|motors| motors.is_late()).map(|_| &self.late[drone]),
                    record: states.get(drone).filter(|states| states.is_late()).map(|_| &mut self.records[drone]),
                    travel: checked.then_some(&mut self.travels[drone]),
                };
                advance_with(flow, lanes, lane_params, &mut extras, count, steps.clone());
            }
        };
        if model.downwash {
            for step in 0..model.substeps {
                compute_downwash(flow.width, lanes, lane_params, count);
                advance(lanes, step..step + 1);
            }
        } else {
            advance(lanes, 0..model.substeps);
        }
        let mut flew = *fits_lanes;
        if checked {
            let free = self.find_untouched(model, shard, range, fits_lanes);
            flew = std::array::from_fn(|lane| clear[lane] || free[lane]);
        }
        if !all {
            let (lanes, _) = lanes_and_params(model, shard, start);
            for lane in (0..count).filter(|&lane| !flew[lane]) {
                lanes.iter_mut().zip(&self.saved).for_each(|(lanes, saved)| lanes.copy_moving_lane(lane, saved));
            }
            let wind = shard.envs.conditions.block(start / LANES, drones).wind;
            for lane in (0..count).filter(|&lane| !flew[lane]) {
                wind.iter_mut().zip(&self.saved_wind).for_each(|(wind, saved)| wind.restore_lane(lane, saved));
            }
        }
        let block_lanes = &shard.envs.lanes[start / LANES * drones..][..drones];
        let motors = shard.envs.conditions.block(start / LANES, drones).motors;
        motors.iter_mut().zip(block_lanes).for_each(|(motors, lanes)| motors.commit(lanes, &flew));
        let batteries = shard.envs.conditions.block(start / LANES, drones).batteries;
        for (batteries, lanes) in batteries.iter_mut().zip(block_lanes) {
            let before = (flew[..count] != [true; LANES][..count]).then(|| batteries.clone());
            advance_batteries(model.width, batteries, lanes, model.control_period, count);
            if let Some(before) = before {
                batteries.keep(&before, &flew);
            }
        }
        let block = &mut shard.envs.blocks[start / LANES];
        for lane in (0..count).filter(|&lane| flew[lane]) {
            block.steps[lane] += 1;
            block.in_mujoco[lane] = false;
            self.flown += u64::from(model.substeps);
        }
        flew
    }
}
