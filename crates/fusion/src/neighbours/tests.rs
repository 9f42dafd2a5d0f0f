//! Two fusion centres as each hears the other.

use crossfix_message::{Payload, Vector3, decode};

use super::*;

/// A target that flies along x at 10 m/s, as a fusion centre says it.
fn said(id: u64, x_m: f64, y_m: f64, sd_m: f64, state: TrackState) -> Track {
    let mut covariance = vec![0.0; 36];
    for axis in 0..3 {
        covariance[axis * 7] = sd_m * sd_m;
        covariance[(axis + 3) * 7] = 1.0;
    }
    Track {
        id,
        state: state.into(),
        position: Some(Vector3 { x: x_m, y: y_m, z: 50.0 }),
        velocity: Some(Vector3 { x: 10.0, y: 0.0, z: 0.0 }),
        covariance,
        ..Default::default()
    }
}

fn frame(seconds: f64, tracks: Vec<Track>) -> TrackFrame {
    let time_ns = Timestamp::from_seconds(1000.0 + seconds).nanos();
    TrackFrame { time_ns, tracks, ..Default::default() }
}

/// West is the first of two centres, east the second.
fn centres() -> [Neighbours; 2] {
    [0, 1].map(|index| Neighbours::new(Share { index, of: 2 }, &FusionConfig::default()))
}

/// Lets both centres say their tracks at a time, and hear each other; returns what each has said.
fn exchange(
    [west, east]: &mut [Neighbours; 2],
    seconds: f64,
    [of_west, of_east]: [Vec<Track>; 2],
) -> [Vec<Track>; 2] {
    let tracks = |outputs: &[Output]| {
        let frames = outputs.iter().filter_map(|output| match output {
            Output::Tracks(frame) => Some(frame.clone()),
            _ => None,
        });
        frames.collect::<Vec<_>>()
    };
    let by_west = tracks(&west.forward(vec![Output::Tracks(frame(seconds, of_west))]));
    by_west.iter().for_each(|frame| east.receive(0, frame));
    let by_east = tracks(&east.forward(vec![Output::Tracks(frame(seconds + 0.01, of_east))]));
    by_east.iter().for_each(|frame| west.receive(1, frame));
    [by_west, by_east].map(|frames| frames.into_iter().flat_map(|frame| frame.tracks).collect())
}

use TrackState::{Coasting, Confirmed, Lost, OneCamera};

/// The numbers that both centres say at one time, as people would see them at each tenth of a
/// second.
fn numbers(said: &[Vec<Track>; 2]) -> Vec<u64> {
    let mut numbers: Vec<u64> = said.iter().flatten().map(|track| track.id).collect();
    numbers.sort_unstable();
    numbers
}

#[test]
fn a_target_that_crosses_the_border_keeps_its_number_and_one_centre_says_it() {
    let mut centres = centres();
    let (mut voices, mut both) = (Vec::new(), 0);
    for step in 0..200 {
        let seconds = f64::from(step) * 0.1;
        let x = 10.0 * seconds;
        // West sees it for 12 s, the last two with one camera; east from 5 s on, a metre beside.
        let west = match step {
            0..100 => vec![said(1, x, 0.0, 1.0, Confirmed)],
            100..120 => vec![said(1, x, 2.0, 20.0, OneCamera)],
            120 => vec![said(1, x, 2.0, 40.0, Lost)],
            _ => vec![],
        };
        let east = if step < 50 { vec![] } else { vec![said(1, x + 0.8, 0.6, 1.0, Confirmed)] };
        let said = exchange(&mut centres, seconds, [west, east]);
        let is_east = !said[1].is_empty();
        let said = said.iter().flatten();
        assert!(said.clone().all(|track| track.id == 1), "at {seconds} s");
        assert!(said.clone().any(|track| track.state() == Confirmed), "at {seconds} s");
        both += i32::from(said.count() == 2);
        voices.push(is_east);
    }
    assert!(voices.is_sorted(), "each says it once: {voices:?}");
    assert_eq!(voices.iter().filter(|&&is_east| is_east).count(), 100, "east from 10 s on");
    assert_eq!(both, 1, "until west has heard that east says it");
}

#[test]
fn a_target_of_which_nobody_hears_any_more_is_said_by_who_is_left() {
    let mut centres = centres();
    for step in 0..30 {
        let x = f64::from(step);
        let both = [vec![said(1, x, 0.0, 1.0, Confirmed)], vec![said(7, x, 0.5, 1.0, Confirmed)]];
        exchange(&mut centres, f64::from(step) * 0.1, both);
    }
    // West has died.
    let silent = (30..60).take_while(|&step| {
        let east = vec![said(7, f64::from(step), 0.5, 1.0, Confirmed)];
        numbers(&exchange(&mut centres, f64::from(step) * 0.1, [vec![], east])).is_empty()
    });
    let tenths = silent.count();
    assert!((8..=10).contains(&tenths), "for as long as it may still be said: {tenths}");
}

#[test]
fn two_targets_side_by_side_are_two() {
    let mut centres = centres();
    for step in 0..100 {
        let x = f64::from(step);
        // Each centre sees one of them, 8 m apart at a metre of error.
        let both = [vec![said(1, x, 0.0, 1.0, Confirmed)], vec![said(1, x, 8.0, 1.0, Confirmed)]];
        let said = exchange(&mut centres, f64::from(step) * 0.1, both);
        assert_eq!(numbers(&said), [1, 2], "odd numbers are west's, even ones east's");
    }
}

#[test]
fn what_may_be_either_of_two_targets_is_neither() {
    let mut centres = centres();
    let mut seen = Vec::new();
    for step in 0..100 {
        let x = f64::from(step);
        let west = vec![said(1, x, 0.0, 1.0, Confirmed), said(2, x, 4.0, 1.0, Confirmed)];
        // Between both, as like the one as the other.
        let east = vec![said(1, x, 2.0, 1.0, Confirmed)];
        seen = numbers(&exchange(&mut centres, f64::from(step) * 0.1, [west, east]));
    }
    assert_eq!(seen, [1, 2, 3], "after two seconds it is said");
}

#[test]
fn who_was_taken_for_another_target_gets_its_own_number_back() {
    let mut centres = centres();
    let mut last = Vec::new();
    for step in 0..120 {
        let x = f64::from(step);
        // Together for four seconds; then they part.
        let aside = (f64::from(step) - 40.0).max(0.0);
        let both = [vec![said(1, x, 0.0, 1.0, Confirmed)], vec![said(1, x, aside, 1.0, Confirmed)]];
        let said = exchange(&mut centres, f64::from(step) * 0.1, both);
        last = numbers(&said);
        if step == 39 {
            assert_eq!(last, [1]);
        }
    }
    assert_eq!(last, [1, 2], "its own");
}

#[test]
fn the_elder_number_wins_whoever_has_the_better_view() {
    let mut centres = centres();
    let (mut merged, mut lost) = (Vec::new(), Vec::new());
    for step in 0..40 {
        let x = f64::from(step);
        let seconds = f64::from(step) * 0.1;
        // East's is a second older; each has been said before the other is heard.
        let [west, east] = &mut centres;
        if step >= 10 {
            let outputs = west.forward(vec![Output::Tracks(frame(
                seconds,
                vec![said(5, x, 0.0, 0.5, Confirmed)],
            ))]);
            for output in &outputs {
                match output {
                    Output::Event(event) => {
                        merged.push((event.kind(), (event.track_id, event.other_id)));
                    }
                    Output::Tracks(said) => {
                        let ended = said.tracks.iter().filter(|track| track.state() == Lost);
                        lost.extend(ended.map(|track| track.id));
                        if step >= 12 {
                            east.receive(0, said);
                        }
                    }
                    _ => {}
                }
            }
        }
        let by_east = east
            .forward(vec![Output::Tracks(frame(seconds, vec![said(9, x, 0.3, 0.5, Confirmed)]))]);
        for output in by_east {
            if let Output::Tracks(said) = output
                && step >= 12
            {
                west.receive(1, &said);
            }
        }
    }
    let merged_of = |(kind, ids)| (kind == TrackEventKind::Merged).then_some(ids);
    let merged: Vec<(u64, u64)> = merged.into_iter().filter_map(merged_of).collect();
    assert_eq!(merged, [(1, 2)], "west's own number goes into east's, and that is said");
    assert_eq!(lost, [1], "and what follows tracks knows that west's is no more");
}

#[test]
fn what_a_neighbour_says_goes_over_the_wire_and_may_be_anything() {
    let mut west = Neighbours::new(Share { index: 0, of: 2 }, &FusionConfig::default());
    let strange = [
        Track::default(),
        Track { covariance: vec![f64::NAN; 36], ..said(1, 0.0, 0.0, 1.0, Confirmed) },
        said(2, f64::INFINITY, 0.0, 1.0, Confirmed),
        said(3, 0.0, 0.0, -1.0, Confirmed),
        Track { covariance: vec![-1.0; 36], ..said(4, 0.0, 0.0, 1.0, Coasting) },
    ];
    let bytes = frame(0.0, strange.into()).encode();
    west.receive(1, &decode(&bytes).unwrap());
    let own = vec![said(1, 0.0, 0.0, 1.0, Confirmed)];
    let mut seen = Vec::new();
    for step in 0..30 {
        let at = frame(f64::from(step) * 0.1, own.clone());
        seen = west.forward(vec![Output::Tracks(at)]);
        west.receive(1, &decode(&bytes).unwrap());
    }
    assert!(matches!(&seen[..], [Output::Tracks(frame)] if frame.tracks[0].id == 1));
}

/// Lets any number of centres, each of which hears all others, say their tracks at a time; returns
/// what each has said.
fn exchange_all(
    centres: &mut [Neighbours],
    seconds: f64,
    tracks: &[Vec<Track>],
) -> Vec<Vec<Track>> {
    let mut all = Vec::new();
    for (index, tracks) in tracks.iter().enumerate() {
        let outputs = centres[index].forward(vec![Output::Tracks(frame(seconds, tracks.clone()))]);
        let mut said = Vec::new();
        for output in outputs {
            if let Output::Tracks(frame) = output {
                let others = (0..centres.len()).filter(|other| *other != index);
                others.for_each(|other| centres[other].receive(index, &frame));
                said.extend(frame.tracks);
            }
        }
        all.push(said);
    }
    all
}

#[test]
fn where_three_areas_meet_a_target_has_one_number() {
    let mut centres: Vec<Neighbours> = (0..3)
        .map(|index| Neighbours::new(Share { index, of: 3 }, &FusionConfig::default()))
        .collect();
    let mut said = Vec::new();
    for step in 0..60 {
        // They find it at the same time, and are not sure at first, when nobody listens.
        let state = if step < 5 { TrackState::Tentative } else { Confirmed };
        let tracks: Vec<Vec<Track>> =
            [0.0, 0.4, -0.5].map(|off| vec![said_at(step, off, state)]).into();
        said = exchange_all(&mut centres, f64::from(step) * 0.1, &tracks);
    }
    let numbers: Vec<u64> = said.iter().flatten().map(|track| track.id).collect();
    assert_eq!(numbers, [1]);
}

fn said_at(step: i32, off_m: f64, state: TrackState) -> Track {
    said(1, f64::from(step), off_m, 1.0, state)
}

#[test]
fn poses_that_disagree_take_a_target_nowhere_and_back() {
    let mut centres = centres();
    let mut changes = 0;
    let mut before = Vec::new();
    for step in 0..900 {
        // They say a metre each, and are 5 to 6.2 m apart, coming and going.
        let off = 5.6 + 0.6 * (f64::from(step) * 0.1).sin();
        let both = [vec![said_at(step, 0.0, Confirmed)], vec![said_at(step, off, Confirmed)]];
        let now = numbers(&exchange(&mut centres, f64::from(step) * 0.1, both));
        changes += i32::from(now != before);
        before = now;
    }
    assert!(changes <= 3, "{changes}");
}

#[test]
fn a_target_that_is_not_seen_lends_its_number_to_nobody_beside_it() {
    let mut centres = centres();
    for step in 0..140 {
        let x = f64::from(step);
        // West's is not seen from 5 s to 9 s; meanwhile east finds another, 35 m beside.
        let coasting_m = (f64::from(step) - 50.0) * 0.5;
        let west = match step {
            50..90 => said(1, x, 0.0, 1.0 + coasting_m, Coasting),
            _ => said(1, x, 0.0, 1.0, Confirmed),
        };
        let east = if step < 60 { vec![] } else { vec![said(1, x, 35.0, 1.0, Confirmed)] };
        let said = exchange(&mut centres, f64::from(step) * 0.1, [vec![west], east]);
        let of_east: Vec<u64> = said[1].iter().map(|track| track.id).collect();
        assert!(of_east.is_empty() || of_east == [2], "at step {step}: {of_east:?}");
        assert_eq!(said[0].iter().map(|track| track.id).collect::<Vec<_>>(), [1], "at {step}");
    }
}

#[test]
fn centres_whose_times_are_apart_know_their_targets_all_the_same() {
    for behind_s in [0.5, 1.5, -1.5] {
        let mut centres = centres();
        let mut heard = Vec::new();
        for step in 0..60 {
            let seconds = f64::from(step) * 0.1;
            let [west, east] = &mut centres;
            let tracks = |seconds: f64| vec![said(1, 10.0 * seconds, 0.3, 0.5, Confirmed)];
            heard.clear();
            for output in west.forward(vec![Output::Tracks(frame(seconds, tracks(seconds)))]) {
                if let Output::Tracks(frame) = output {
                    east.receive(0, &frame);
                    heard.extend(frame.tracks.iter().map(|track| track.id));
                }
            }
            let late_s = seconds - behind_s;
            for output in east.forward(vec![Output::Tracks(frame(late_s, tracks(late_s)))]) {
                if let Output::Tracks(frame) = output {
                    west.receive(1, &frame);
                    heard.extend(frame.tracks.iter().map(|track| track.id));
                }
            }
        }
        // The number of the centre that has seen it since an earlier time.
        assert_eq!(heard, if behind_s > 0.0 { [2] } else { [1] }, "{behind_s}");
    }
}

#[test]
fn who_says_anothers_number_elsewhere_silences_nobody() {
    let mut west = Neighbours::new(Share { index: 1, of: 2 }, &FusionConfig::default());
    for step in 0..60 {
        let seconds = f64::from(step) * 0.1;
        let own = vec![said_at(step, 0.0, Confirmed)];
        let outputs = west.forward(vec![Output::Tracks(frame(seconds, own))]);
        let is_said = matches!(&outputs[..], [Output::Tracks(frame)] if frame.tracks[0].id == 2);
        assert!(is_said, "at {seconds} s: {outputs:?}");
        // Said by somebody whose list of areas is another, 500 m away.
        west.receive(0, &frame(seconds, vec![said(2, f64::from(step), 500.0, 0.1, Confirmed)]));
    }
}

#[test]
fn time_that_goes_back_leaves_nothing_behind() {
    let mut west = Neighbours::new(Share { index: 0, of: 2 }, &FusionConfig::default());
    for round in 0..20 {
        for step in 0..30 {
            let seconds = f64::from(step) * 0.1 - f64::from(round) * 100.0;
            let tracks = vec![said(round as u64 + 1, f64::from(step), 0.0, 1.0, Confirmed)];
            west.forward(vec![Output::Tracks(frame(seconds, tracks))]);
        }
        // As where event time starts again: an event, and no frame.
        let lost = event(TrackEventKind::Lost, west.now.unwrap(), [round as u64 + 1, 0]);
        assert_eq!(west.forward(vec![Output::Event(lost)]).len(), 1, "it is said");
    }
    assert!(west.ours.len() <= 2, "{}", west.ours.len());
}
