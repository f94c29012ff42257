"""The tests that hold each paragraph of docs/paper_preset.md, by the paragraph's digest (`paper_preset_page.digest`).

Tables with a column "paper" are in `paper_preset_facts.py`. Where a paragraph says what a published code does, the
place is beside it as there: P is the paper, S its supplement, C its published code.
"""

_OPTIONS = "test_options_that_pages_name_exist"

HELD = {
    # `mien train ... --preset paper --split gaussian-avatars`
    "a255ca53": "test_commands_of_the_page_give_what_they_are_for test_train_takes_the_split_by_name",
    # `--preset paper` gives a run the settings of the method's paper
    "904c4a43": "test_a_preset_gives_the_settings_of_run_and_method test_every_method_of_a_paper_has_the_preset "
    "test_presets_are_differences_to_the_defaults test_help_all_shows_where_presets_differ "
    "test_what_no_table_lists_is_as_in_standard test_the_run_of_every_method_has_the_settings_of_the_first_table",
    # All times are fractions of the run
    "9166a686": "test_a_shorter_run_has_the_same_schedule test_the_page_has_the_schedule_of_a_short_run",
    # What was measured ... is in the log
    "5ff1d6dd": "test_links_lead_somewhere",
    # No paper closes sides that were not filmed (P of each: they train on what was filmed alone)
    "b1211533": "test_the_run_of_every_method_has_the_settings_of_the_first_table",
    # | setting | default | here |
    "310454c6": "test_docs_have_values_that_differ_from_the_default",
    # The frames that the paper holds out (S of GaussianAvatars: B)
    "e599126f": "test_what_is_held_out_is_no_part_of_the_preset test_table_2 test_links_lead_somewhere",
    # GaussianAvatars: "Paper" is ...
    "0bbaefcd": "test_every_row_has_its_place_and_tests_that_exist",
    # What no setting says and yet differs (C: density control grows, then prunes; it mixes the frames of a split)
    "fb2ed6e5": "test_a_round_prunes_first_so_that_what_goes_does_not_grow "
    "test_split_children_are_samples_of_their_parent test_gradients_weigh_by_the_pictures_own_width_and_height",
    # `--method.density.rules.prune-wide True` removes
    "49cbaa27": f"test_each_rule_has_a_switch test_figures_of_wide_gaussians_are_those_of_the_log {_OPTIONS}",
    # | clip | steps | removed | kept |
    "9a7f8732": "test_figures_of_wide_gaussians_are_those_of_the_log",
    # With the rule, foreheads get holes
    "5f1e10ec": "test_figures_of_wide_gaussians_are_those_of_the_log",
    # E is 1.1 times the largest distance (C: optimiser)
    "0ac4253e": "test_extent_is_that_of_the_training_cameras test_the_page_has_the_numbers_of_the_extent",
    # E is at least 0.5 m
    "c287b0f1": "test_extent_is_that_of_the_training_cameras test_the_page_has_the_numbers_of_the_extent "
    "test_with_an_extent_of_0_nothing_moves_all_is_split_and_all_is_too_large",
    # The defaults give sizes in metres
    "a7f7466c": "test_defaults_that_the_page_names test_extent_reaches_rates_in_its_unit_only",
    # The paper tunes the tracked face of every frame with one dense Adam (C: optimiser)
    "e1d4b552": "test_a_dense_adam_moves_a_frame_by_the_root_of_the_number_of_frames "
    "test_each_frame_has_moments_and_a_step_count_of_its_own test_face_track_moves_only_the_timestep_that_was_used",
    # How far a dense Adam moves a frame (S: B has the nine sequences)
    "c572d6d3": "test_the_page_has_the_factors_of_a_dense_adam "
    "test_face_rates_do_per_visit_what_the_papers_dense_optimiser_does "
    "test_a_dense_adam_moves_a_frame_by_the_root_of_the_number_of_frames",
    # The rate of the expression is per coefficient of FLAME (Li et al. 2017)
    "bc4562b0": "test_figures_of_rates_in_units_of_flame_are_those_of_the_log",
    # `mien train ... --method.face-tuning.expression.start 1e-3`
    "4be95839": "test_commands_of_the_page_give_what_they_are_for",
    # HeadGaS: there is no published code
    "8b904f73": "test_every_row_has_its_place_and_tests_that_exist",
    # The perceptual loss took 2.4 s a step
    "c45e5352": "test_times_of_headgas_are_those_of_the_log",
    # `mien train ... --method.photometric.perceptual.weight 0`
    "7ee82720": "test_commands_of_the_page_give_what_they_are_for",
    # MonoGaussianAvatar: "Paper" is ... An epoch is ... Lengths are ...
    "88064144": "test_every_row_has_its_place_and_tests_that_exist test_epochs_and_units_of_mono_gaussian_avatar",
    # The two schedules, by epoch
    "e91fb41f": "test_docs_have_the_counts_and_radii_of_both_schedules",
    "d0dc4efa": "test_docs_have_the_counts_and_radii_of_both_schedules test_schedules_are_those_of_paper_and_code",
    # `paper` puts new points on a sphere (S: B.1; C: points, optimiser, networks)
    "4ce7a81b": "test_children_are_around_their_parents test_lengths_of_late_children "
    "test_moments_of_points_and_networks_outlive_a_round test_each_head_predicts_its_own_attribute "
    "test_a_turn_of_the_head_alone_changes_no_attribute_of_the_heads_own_points",
    # `--preset paper-cpu` is the preset `paper` in a small size
    "9065dd29": "test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points",
    "80b4cbd4": "test_commands_of_the_page_give_what_they_are_for",
    "4c654b37": "test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points",
    # All else is equal, also the 120 epochs
    "2c261a2b": "test_the_preset_for_processors_is_that_of_the_paper_with_fewer_frames_and_points",
    # PointAvatar: "Paper" is ...
    "3902549f": "test_every_row_has_its_place_and_tests_that_exist test_no_run_of_point_avatars_preset_is_among_ours "
    "test_docs_have_all_values_of_point_avatar",
}
