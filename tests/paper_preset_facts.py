"""Statements of the papers, each with its place: the column "paper" of docs/paper_preset.md, and why mien differs.

Places are the paper (P), its supplement (S) with the section, the published code (C) with the part of it, or another
work by name. Main papers are known by the numbers that other papers quote of them. `tests/test_paper_preset_page.py`
compares every row with the page. A row that says why has the names of the tests that hold this, unless the reason is a
fact of the paper, which the place covers.
"""

from typing import NamedTuple

SPLATTING = "3D Gaussian Splatting, published code"
SUCCESSOR = "C of MonoGaussianAvatar"
NOT_STATED = "in none of the texts"


class Row(NamedTuple):
    """One row of a table."""

    published: str
    """The column "paper"."""
    place: str
    """Place where that is published."""
    why: str = ""
    """The column "why different"."""
    held: str = ""
    """The tests that hold why, separated by blanks."""


_RATES = ('See "Rates of the face".', "test_face_rates_do_per_visit_what_the_papers_dense_optimiser_does")

GAUSSIAN_AVATARS = {
    "steps": Row("600,000", "C: training"),
    "sh_degree": Row(
        "3",
        "C: model; advice in the code's issue 112",
        "With one camera set `--method.sh-degree 0`, as the authors advise.",
        "test_options_that_pages_name_exist",
    ),
    "sh_warmup": Row("one more degree every 1,000 steps", "C: training"),
    "means_rate": Row("5e-3 to 5e-5, log-linear", "C: optimiser"),
    "means_times_extent": Row(
        "rate times E", "C: optimiser", "E has a floor, see below.", "test_extent_is_that_of_the_training_cameras"
    ),
    "density.start": Row(
        "after step 10,000",
        "C: density control",
        "The published code's first round is at step 12,000.",
        "test_schedule",
    ),
    "density.rounds": Row("every 2,000 steps", "C: density control"),
    "density.stop": Row(
        "to the end",
        "C: density control",
        "A round after the last step would leave Gaussians that no step has fitted.",
        "test_no_round_or_reset_is_after_the_last_step",
    ),
    "density.grow_gradient": Row("2e-4", "C: density control"),
    "density.size_unit": Row("E", "C: density control"),
    "density.split_size": Row(".01 E", "C: density control"),
    "density.prune_size": Row(".1 E, from step 60,000", "C: density control"),
    "density.prune_radius, density.rules.prune_wide": Row(
        "20 pixels, from step 60,000; code: never, because it clears the radii before it compares them",
        "P; C: density control",
        'As the code, which is better: see "Wide Gaussians".',
        "test_figures_of_wide_gaussians_are_those_of_the_log",
    ),
    "density.prune_opacity": Row(".005", "C: density control"),
    "density.opacity_resets": Row(
        "steps 10,000 (over white) and every 60,000, to .01",
        "C: density control",
        "A reset after the last step would leave a transparent avatar.",
        "test_no_round_or_reset_is_after_the_last_step",
    ),
    "density.max_gaussians": Row(
        "no limit; about 100,000 result",
        "C: density control; S: C, figure 3a",
        "A bound for memory. `--method.density.rules.cap False` lifts it.",
        "test_each_rule_has_a_switch test_options_that_pages_name_exist",
    ),
    "photometric": Row(".8 L1 + .2 (1 - SSIM)", "P; C: loss"),
    "expression_rank": Row(
        "none",
        "P; C: model",
        "`expression_color_rate` and `expression_opacity_rate` count only with a rank above 0.",
        "test_rates_of_expressions_count_only_with_a_rank",
    ),
    "appearance": Row(
        "colours and opacities do not change",
        "P; C: model",
        "The default has the features of HeadGaS.",
        "test_defaults_that_the_page_names",
    ),
    "position_weight, position_threshold": Row(".01, 1", "P; C: loss"),
    "scale_weight, scale_threshold": Row("1, .6", "P; C: loss"),
    "face_tuning.expression": Row("1e-3", "C: optimiser", *_RATES),
    "face_tuning.joints": Row("1e-5", "C: optimiser", *_RATES),
    "face_tuning.head_rotation": Row("1e-5", "C: optimiser", *_RATES),
    "face_tuning.head_translation": Row("1e-6", "C: optimiser", *_RATES),
    "face_tuning.keep_mean_pose, face_tuning.keep_turns": Row("no", "C: training"),
}

HEADGAS = {
    "steps": Row("50,000", "P"),
    "points": Row(
        "2,500",
        "P",
        "The paper takes vertices of the face model, mien random points of its surface.",
        "test_points_are_on_the_mesh_evenly_by_area",
    ),
    "features, hidden": Row("32, 64", "P"),
    "directions": Row(
        "one basis for each expression coefficient",
        "S: 1 and 2",
        "The bases are along principal directions of the tracked faces, which is the same set of functions.",
        "test_all_directions_span_the_inputs_and_few_the_largest_spread",
    ),
    "inputs": Row(
        "expression coefficients",
        "S: 1 and 2",
        "Nothing else would move the gaze.",
        "test_joints_change_colors_also_when_baked test_nothing_moves_in_the_head_frame",
    ),
    "sh_degree": Row("3", "P", "`standard` has 0.", "test_defaults_that_the_page_names"),
    "sh_warmup": Row("not stated; one more degree every 1,000 steps in 3D Gaussian Splatting", SPLATTING),
    "sh_higher_share": Row(
        "not stated; a twentieth of the rate in 3D Gaussian Splatting",
        SPLATTING,
        "The network's outputs of higher degrees are multiplied by it.",
        "test_higher_degrees_learn_slower_and_begin_later",
    ),
    "means_rate, means_times_extent": Row("not stated; 1.6e-4 to 1.6e-6 times E in 3D Gaussian Splatting", SPLATTING),
    "log_scales_rate, quats_rate": Row("not stated; 5e-3, 1e-3 in 3D Gaussian Splatting", SPLATTING),
    "features_rate, network_rate": Row("not stated", NOT_STATED, "chosen"),
    "factored_bases": Row(
        "not stated; Adam in 3D Gaussian Splatting",
        SPLATTING,
        "The default has one second moment for all bases of a Gaussian and no first one.",
        "test_paper_trains_bases_by_adam_and_centres_through_their_encoding",
    ),
    "encoding_gradient": Row(
        "yes, by its equations",
        "S: 2, equation 1",
        "By default, centres do not move by the encoding of their position.",
        "test_paper_trains_bases_by_adam_and_centres_through_their_encoding",
    ),
    "network_epsilon": Row("not stated; 1e-8 in Adam's own paper", "Kingma and Ba 2015, algorithm 1"),
    "encoding_bands, encoding_length": Row("not stated", NOT_STATED, "chosen"),
    "density.start, stop, rounds": Row("after step 500 and before 15,000, every 100 steps", "P; " + SPLATTING),
    "density.grow_gradient, split_size, size_unit": Row("2e-4, .01 E in 3D Gaussian Splatting", SPLATTING),
    "density.prune_size, size_start": Row(
        ".1 E in 3D Gaussian Splatting",
        SPLATTING,
        "It does not wait for an opacity reset, because there is none.",
        "test_pruning_by_size_may_begin_without_resets",
    ),
    "density.opacity_resets": Row(
        "not stated",
        NOT_STATED,
        "Opacities come from the network.",
        "test_opacity_has_no_reset_and_counts_by_the_highest_seen",
    ),
    "judged_expressions": Row(
        "not stated",
        NOT_STATED,
        "A Gaussian is pruned if its opacity is low at all of these expressions and in all steps since the last round.",
        "test_opacities_count_at_expressions_that_no_step_drew "
        "test_opacity_has_no_reset_and_counts_by_the_highest_seen",
    ),
    "density.max_gaussians": Row(
        "21,000 to 37,000 result", "S: 3, figure 4", "A bound for memory.", "test_each_rule_has_a_switch"
    ),
    "face_tuning": Row("not stated", NOT_STATED),
    "photometric.perceptual": Row(
        "weight 0.1 on the head's box, from step 10,000", "P; S: equations 4 and 5", "Which features, it does not say."
    ),
}

MONO_GAUSSIAN_AVATAR = {
    "steps": Row(
        "not stated; results at epochs 60 to 120",
        "C: evaluation",
        "Frames, not updates: about 218,000 updates.",
        "test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points",
    ),
    "frames_per_step, points_per_step": Row(
        "8 frames, fewer beyond 12,800 points: 102,400 points, summed over the frames, at most", "C: training"
    ),
    "start, points, sphere_radius": Row("400 on a sphere of 0.125 m", "S: B.1; C: points"),
    "pretraining": Row("none", "C: training"),
    "own_rate": Row("points have no attributes of their own", "S: B.2; C: points"),
    "max_points": Row("100,000", "S: B.1"),
    "first_epoch, epochs": Row("prune and refill after every epoch", "S: B.1; C: points"),
    "schedule": Row(
        "counts and radii of the supplement",
        "S: B.1",
        "The published code differs: `--method.schedule code`.",
        "test_schedules_are_those_of_paper_and_code test_options_that_pages_name_exist",
    ),
    "late_epoch": Row(
        "new points 0.001 m from their parents beyond epoch 100",
        "S: B.1; C: points",
        "The default begins with epoch 102.",
        "test_the_round_into_epoch_101_is_the_first_with_the_late_length_in_paper",
    ),
    "attribute_width, attribute_layers": Row("256, 7", "S: figure 14; C: networks"),
    "encoding_bands": Row("6", "C: networks"),
    "sphere_start": Row("yes", "C: networks"),
    "deformation_width": Row("128", "S: figure 15; C: networks"),
    "skinning_norm": Row("weight normalisation on the skinning branch", "S: figure 15"),
    "change_width": Row("64", "S: figure 15; C: networks"),
    "scale_gain": Row("0.00625 at 512x512, 0.0025 at 1024x1024", "C: model"),
    "means_rate": Row("2.5e-5", "S: B.3"),
    "network_rate": Row("1e-4", "S: B.3"),
    "adam_epsilon": Row("1e-8", "C: optimiser, which keeps PyTorch's own"),
    "rate_halvings": Row(
        "epochs 80 and 100",
        "S: B.3; C: optimiser",
        "In the published code, the halvings never reach the optimiser in use.",
    ),
    "face_skinning_weight": Row(
        "1, in the code, too",
        "S: B.3; C: loss",
        "All three halve at epochs 20, 30, 50 and 70, as in the code.",
        "test_schedules_are_those_of_paper_and_code test_losses_near_the_face_model_are_those_of_the_paper",
    ),
    "face_expression_weight, face_expression_by_variance": Row(
        "1,000; code: 10,000 divided by 50 and by each coefficient's variance",
        "S: B.3; C: loss",
        "`--method.face-expression-weight 1e4 --method.face-expression-by-variance True` is the code's.",
        "test_losses_near_the_face_model_are_those_of_the_paper test_options_that_pages_name_exist",
    ),
    "face_correctives_weight": Row("1,000; code: 10,000", "S: B.3; C: loss"),
    "face_points": Row("all points", "C: loss"),
    "photometric": Row("L1 + .25 (1 - SSIM)", "S: B.3"),
    "photometric.perceptual": Row(
        ".1, four blocks of a VGG16 on the whole picture at 224x224",
        "S: B.3; C: loss",
        "mien compares crops in their own resolution.",
        "test_crops_lie_in_the_picture_and_visit_every_part",
    ),
    "face_tuning.expression, joints, head_rotation": Row(
        "not stated in the supplement; code: 5e-4 from epoch 11",
        "C: optimiser",
        "The code begins after epoch 10 has ended.",
    ),
    "face_tuning.head_translation": Row(
        "not stated in the supplement; code: 5e-4 from epoch 11",
        "C: optimiser",
        "In the published code it never reaches the picture.",
    ),
}

POINT_AVATAR = {
    "steps": Row("not stated; 11 hours on a GPU", "S of MonoGaussianAvatar: table 4"),
    "frames_per_step": Row("not stated", NOT_STATED),
    "start, points, sphere_radius": Row(
        "few points at first; 400 on a sphere of 0.125 m in the successor", "S of GaussianAvatars: D; " + SUCCESSOR
    ),
    "pretraining": Row("none in the successor", SUCCESSOR),
    "max_points, growth_epochs, epochs": Row(
        "grows while the radius shrinks",
        "S of GaussianAvatars: D",
        "The number doubles every 5 epochs, as in the successor.",
        "test_points_double_and_shrink_together test_docs_have_the_counts_and_radii_of_both_schedules",
    ),
    "first_radius, radius_factor": Row("not stated; 0.0375 for 100 points and 0.75 in the successor's code", SUCCESSOR),
    "normals": Row(
        "not stated",
        NOT_STATED,
        "Light then changes while a head turns. The default has those of the points at rest, which can be exported.",
        "test_light_follows_deformed_normals_as_the_head_turns "
        "test_avatars_with_deformed_normals_say_why_they_cannot_be_exported",
    ),
    "surface_width, surface_layers, encoding_bands": Row(
        "not stated", NOT_STATED, "As the successor's attribute network.", "test_point_avatar_has_the_successors_sizes"
    ),
    "deformation_width": Row("128 in the successor", SUCCESSOR),
    "shading_width": Row("64 in the successor's code, which does not use that network", SUCCESSOR),
    "means_rate, network_rate": Row("1e-4 in the successor", SUCCESSOR),
    "face_skinning_weight, face_expression_weight, face_correctives_weight": Row(
        "1, 1,000 and 1,000 in the successor", "S of MonoGaussianAvatar: B.3"
    ),
    "face_points": Row("all points in the successor", SUCCESSOR),
    "distance_weight, slope_weight": Row("not stated", NOT_STATED, "chosen"),
    "photometric": Row(
        "not stated; L1, SSIM and features in the successor", "S of MonoGaussianAvatar: B.3", "No SSIM: chosen."
    ),
    "face_tuning": Row("5e-4 from epoch 11 in the successor's code", SUCCESSOR),
    "closing": Row(
        "erosion and dilation, by 3x3 pixels in the successor's code", "S of GaussianAvatars: D; " + SUCCESSOR
    ),
}

FACTS = {
    "GaussianAvatars": GAUSSIAN_AVATARS,
    "HeadGaS": HEADGAS,
    "MonoGaussianAvatar": MONO_GAUSSIAN_AVATAR,
    "PointAvatar": POINT_AVATAR,
}
