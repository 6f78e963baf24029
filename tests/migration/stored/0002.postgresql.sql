CREATE TABLE public.alembic_version (
    version_num character varying(32) NOT NULL
);
CREATE TABLE public.campaigns (
    id integer NOT NULL,
    machine_id integer NOT NULL,
    name character varying(200) NOT NULL,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.campaigns_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.campaigns_id_seq OWNED BY public.campaigns.id;
CREATE TABLE public.chunks (
    id integer NOT NULL,
    run_id integer NOT NULL,
    channel character varying(40) NOT NULL,
    seq integer NOT NULL,
    n integer NOT NULL,
    codec character varying(20) NOT NULL,
    crc32 bigint NOT NULL,
    payload bytea NOT NULL,
    first_host_s double precision NOT NULL,
    last_host_s double precision NOT NULL,
    first_device_us bigint NOT NULL,
    last_device_us bigint NOT NULL
);
CREATE SEQUENCE public.chunks_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.chunks_id_seq OWNED BY public.chunks.id;
CREATE TABLE public.discoveries (
    id integer NOT NULL,
    campaign_id integer NOT NULL,
    digest character varying(64) NOT NULL,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.discoveries_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.discoveries_id_seq OWNED BY public.discoveries.id;
CREATE TABLE public.discovery_steps (
    id integer NOT NULL,
    discovery_id integer NOT NULL,
    seq integer NOT NULL,
    state character varying(30) NOT NULL,
    doc json NOT NULL,
    utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.discovery_steps_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.discovery_steps_id_seq OWNED BY public.discovery_steps.id;
CREATE TABLE public.machine_models (
    id integer NOT NULL,
    machine character varying(200) NOT NULL,
    version integer NOT NULL,
    discovery_id integer,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.machine_models_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.machine_models_id_seq OWNED BY public.machine_models.id;
CREATE TABLE public.machines (
    id integer NOT NULL,
    name character varying(200) NOT NULL,
    doc json NOT NULL,
    doc_hash character varying(64) NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.machines_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.machines_id_seq OWNED BY public.machines.id;
CREATE TABLE public.outbox (
    id integer NOT NULL,
    topic character varying(500) NOT NULL,
    payload bytea NOT NULL,
    created_utc character varying(32) NOT NULL,
    sent_utc character varying(32)
);
CREATE SEQUENCE public.outbox_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.outbox_id_seq OWNED BY public.outbox.id;
CREATE TABLE public.pushes (
    id integer NOT NULL,
    machine_id integer NOT NULL,
    table_id integer NOT NULL,
    state character varying(30) NOT NULL,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL,
    updated_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.pushes_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.pushes_id_seq OWNED BY public.pushes.id;
CREATE TABLE public.runs (
    id integer NOT NULL,
    campaign_id integer NOT NULL,
    label character varying(100) NOT NULL,
    test character varying(40) NOT NULL,
    role character varying(20) NOT NULL,
    status character varying(20) NOT NULL,
    reason text NOT NULL,
    start_doc json NOT NULL,
    end_doc json,
    started_utc character varying(32) NOT NULL,
    ended_utc character varying(32),
    owner_host character varying(255) NOT NULL,
    owner_pid integer NOT NULL,
    owner_start character varying(80) NOT NULL
);
CREATE SEQUENCE public.runs_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.runs_id_seq OWNED BY public.runs.id;
CREATE TABLE public.slots (
    id integer NOT NULL,
    schedule character varying(200) NOT NULL,
    slot_utc character varying(32) NOT NULL,
    state character varying(30) NOT NULL,
    claimed_utc character varying(32) NOT NULL,
    finished_utc character varying(32)
);
CREATE SEQUENCE public.slots_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.slots_id_seq OWNED BY public.slots.id;
CREATE TABLE public.solutions (
    id integer NOT NULL,
    campaign_id integer NOT NULL,
    kind character varying(40) NOT NULL,
    run_ids json NOT NULL,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.solutions_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.solutions_id_seq OWNED BY public.solutions.id;
CREATE TABLE public.tables (
    id integer NOT NULL,
    machine_id integer NOT NULL,
    solution_id integer,
    image bytea NOT NULL,
    crc bigint NOT NULL,
    doc json NOT NULL,
    created_utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.tables_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.tables_id_seq OWNED BY public.tables.id;
CREATE TABLE public.verifications (
    id integer NOT NULL,
    machine_id integer NOT NULL,
    campaign_id integer,
    verdict character varying(30) NOT NULL,
    doc json NOT NULL,
    utc character varying(32) NOT NULL
);
CREATE SEQUENCE public.verifications_id_seq
    AS integer
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE public.verifications_id_seq OWNED BY public.verifications.id;
ALTER TABLE ONLY public.campaigns ALTER COLUMN id SET DEFAULT nextval('public.campaigns_id_seq'::regclass);
ALTER TABLE ONLY public.chunks ALTER COLUMN id SET DEFAULT nextval('public.chunks_id_seq'::regclass);
ALTER TABLE ONLY public.discoveries ALTER COLUMN id SET DEFAULT nextval('public.discoveries_id_seq'::regclass);
ALTER TABLE ONLY public.discovery_steps ALTER COLUMN id SET DEFAULT nextval('public.discovery_steps_id_seq'::regclass);
ALTER TABLE ONLY public.machine_models ALTER COLUMN id SET DEFAULT nextval('public.machine_models_id_seq'::regclass);
ALTER TABLE ONLY public.machines ALTER COLUMN id SET DEFAULT nextval('public.machines_id_seq'::regclass);
ALTER TABLE ONLY public.outbox ALTER COLUMN id SET DEFAULT nextval('public.outbox_id_seq'::regclass);
ALTER TABLE ONLY public.pushes ALTER COLUMN id SET DEFAULT nextval('public.pushes_id_seq'::regclass);
ALTER TABLE ONLY public.runs ALTER COLUMN id SET DEFAULT nextval('public.runs_id_seq'::regclass);
ALTER TABLE ONLY public.slots ALTER COLUMN id SET DEFAULT nextval('public.slots_id_seq'::regclass);
ALTER TABLE ONLY public.solutions ALTER COLUMN id SET DEFAULT nextval('public.solutions_id_seq'::regclass);
ALTER TABLE ONLY public.tables ALTER COLUMN id SET DEFAULT nextval('public.tables_id_seq'::regclass);
ALTER TABLE ONLY public.verifications ALTER COLUMN id SET DEFAULT nextval('public.verifications_id_seq'::regclass);
INSERT INTO public.alembic_version VALUES ('0002');
INSERT INTO public.campaigns VALUES (1, 1, 'june', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.chunks VALUES (1, 1, 'bar', 0, 32, 'raw', 688229491, '\x000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435363738393a3b3c3d3e3f404142434445464748494a4b4c4d4e4f505152535455565758595a5b5c5d5e5f606162636465666768696a6b6c6d6e6f707172737475767778797a7b7c7d7e7f808182838485868788898a8b8c8d8e8f909192939495969798999a9b9c9d9e9fa0a1a2a3a4a5a6a7a8a9aaabacadaeafb0b1b2b3b4b5b6b7b8b9babbbcbdbebfc0c1c2c3c4c5c6c7c8c9cacbcccdcecfd0d1d2d3d4d5d6d7d8d9dadbdcdddedfe0e1e2e3e4e5e6e7e8e9eaebecedeeeff0f1f2f3f4f5f6f7f8f9fafbfcfdfeff', 0.1, 0.2, 1099511627776, 1099511627785);
INSERT INTO public.chunks VALUES (2, 1, 'bar', 1, 32, 'raw', 476132726, '\x000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435363738393a3b3c3d3e3f404142434445464748494a4b4c4d4e4f505152535455565758595a5b5c5d5e5f606162636465666768696a6b6c6d6e6f707172737475767778797a7b7c7d7e7f808182838485868788898a8b8c8d8e8f909192939495969798999a9b9c9d9e9fa0a1a2a3a4a5a6a7a8a9aaabacadaeafb0b1b2b3b4b5b6b7b8b9babbbcbdbebfc0c1c2c3c4c5c6c7c8c9cacbcccdcecfd0d1d2d3d4d5d6d7d8d9dadbdcdddedfe0e1e2e3e4e5e6e7e8e9eaebecedeeeff0f1f2f3f4f5f6f7f8f9fafbfcfdfeff000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435363738393a3b3c3d3e3f404142434445464748494a4b4c4d4e4f505152535455565758595a5b5c5d5e5f606162636465666768696a6b6c6d6e6f707172737475767778797a7b7c7d7e7f808182838485868788898a8b8c8d8e8f909192939495969798999a9b9c9d9e9fa0a1a2a3a4a5a6a7a8a9aaabacadaeafb0b1b2b3b4b5b6b7b8b9babbbcbdbebfc0c1c2c3c4c5c6c7c8c9cacbcccdcecfd0d1d2d3d4d5d6d7d8d9dadbdcdddedfe0e1e2e3e4e5e6e7e8e9eaebecedeeeff0f1f2f3f4f5f6f7f8f9fafbfcfdfeff', 0.1, 1.2, 1099511627777, 1099511627785);
INSERT INTO public.discoveries VALUES (1, 1, 'abababababababababababababababababababababababababababababababab', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.discovery_steps VALUES (1, 1, 0, 'BEGUN', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.discovery_steps VALUES (2, 1, 1, 'NAMED', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.machine_models VALUES (1, 'VMC-1 ü''', 1, 1, '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.machine_models VALUES (2, 'VMC-1 ü''', 2, 1, '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.machines VALUES (1, 'VMC-1 ü''', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '30169858a32ee8bb28b1a24b7e474f90dfab15e5c2b0e89e124ebb124542e994', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.outbox VALUES (1, 'plant/abbe/state', '\x7b225c75303062356d223a20302e312c20226c697374223a205b6e756c6c2c2031652d30372c202d302e305d2c202274657874223a20225c7530306663275c225c6e5c5c205c7535646535222c20226c61726765223a20393030373139393235343734303939337d', '2026-11-21T03:34:05.123456Z', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.outbox VALUES (2, 'plant/abbe/alarm', '\x3fb999999999999a', '2026-11-21T03:34:05.123456Z', NULL);
INSERT INTO public.pushes VALUES (1, 1, 1, 'KEEP', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.runs VALUES (1, 1, 'r1', 'helix', 'fit', 'complete', '', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z', '2026-11-21T03:34:05.123456Z', 'vm', 32696, 'af4569a6-3467-4c95-a877-9313cf97f9e6/171695');
INSERT INTO public.runs VALUES (2, 1, 'r2', 'helix', 'verify', 'running', '', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', NULL, '2026-11-21T03:34:05.123456Z', NULL, 'vm', 32696, 'af4569a6-3467-4c95-a877-9313cf97f9e6/171695');
INSERT INTO public.slots VALUES (1, 'weekly', '2026-11-20T05:00:00.000000Z', 'done', '2026-11-21T03:34:05.123456Z', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.slots VALUES (2, 'weekly', '2026-11-27T05:00:00.000000Z', 'claimed', '2026-11-21T03:34:05.123456Z', NULL);
INSERT INTO public.solutions VALUES (1, 1, 'joint', '[1]', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.tables VALUES (1, 1, 1, '\x000102030405060708090a0b0c0d0e0f101112131415161718191a1b1c1d1e1f202122232425262728292a2b2c2d2e2f303132333435363738393a3b3c3d3e3f404142434445464748494a4b4c4d4e4f505152535455565758595a5b5c5d5e5f606162636465666768696a6b6c6d6e6f707172737475767778797a7b7c7d7e7f808182838485868788898a8b8c8d8e8f909192939495969798999a9b9c9d9e9fa0a1a2a3a4a5a6a7a8a9aaabacadaeafb0b1b2b3b4b5b6b7b8b9babbbcbdbebfc0c1c2c3c4c5c6c7c8c9cacbcccdcecfd0d1d2d3d4d5d6d7d8d9dadbdcdddedfe0e1e2e3e4e5e6e7e8e9eaebecedeeeff0f1f2f3f4f5f6f7f8f9fafbfcfdfeff', 4294967295, '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
INSERT INTO public.verifications VALUES (1, 1, 1, 'cannot tell', '{"µm":0.1,"list":[null,1e-07,-0.0],"text":"ü''\"\n\\ 工","large":9007199254740993}', '2026-11-21T03:34:05.123456Z');
SELECT pg_catalog.setval('public.campaigns_id_seq', 1, true);
SELECT pg_catalog.setval('public.chunks_id_seq', 2, true);
SELECT pg_catalog.setval('public.discoveries_id_seq', 1, true);
SELECT pg_catalog.setval('public.discovery_steps_id_seq', 2, true);
SELECT pg_catalog.setval('public.machine_models_id_seq', 2, true);
SELECT pg_catalog.setval('public.machines_id_seq', 1, true);
SELECT pg_catalog.setval('public.outbox_id_seq', 2, true);
SELECT pg_catalog.setval('public.pushes_id_seq', 1, true);
SELECT pg_catalog.setval('public.runs_id_seq', 2, true);
SELECT pg_catalog.setval('public.slots_id_seq', 2, true);
SELECT pg_catalog.setval('public.solutions_id_seq', 1, true);
SELECT pg_catalog.setval('public.tables_id_seq', 1, true);
SELECT pg_catalog.setval('public.verifications_id_seq', 1, true);
ALTER TABLE ONLY public.alembic_version
    ADD CONSTRAINT alembic_version_pkc PRIMARY KEY (version_num);
ALTER TABLE ONLY public.campaigns
    ADD CONSTRAINT pk_campaigns PRIMARY KEY (id);
ALTER TABLE ONLY public.chunks
    ADD CONSTRAINT pk_chunks PRIMARY KEY (id);
ALTER TABLE ONLY public.discoveries
    ADD CONSTRAINT pk_discoveries PRIMARY KEY (id);
ALTER TABLE ONLY public.discovery_steps
    ADD CONSTRAINT pk_discovery_steps PRIMARY KEY (id);
ALTER TABLE ONLY public.machine_models
    ADD CONSTRAINT pk_machine_models PRIMARY KEY (id);
ALTER TABLE ONLY public.machines
    ADD CONSTRAINT pk_machines PRIMARY KEY (id);
ALTER TABLE ONLY public.outbox
    ADD CONSTRAINT pk_outbox PRIMARY KEY (id);
ALTER TABLE ONLY public.pushes
    ADD CONSTRAINT pk_pushes PRIMARY KEY (id);
ALTER TABLE ONLY public.runs
    ADD CONSTRAINT pk_runs PRIMARY KEY (id);
ALTER TABLE ONLY public.slots
    ADD CONSTRAINT pk_slots PRIMARY KEY (id);
ALTER TABLE ONLY public.solutions
    ADD CONSTRAINT pk_solutions PRIMARY KEY (id);
ALTER TABLE ONLY public.tables
    ADD CONSTRAINT pk_tables PRIMARY KEY (id);
ALTER TABLE ONLY public.verifications
    ADD CONSTRAINT pk_verifications PRIMARY KEY (id);
ALTER TABLE ONLY public.campaigns
    ADD CONSTRAINT uq_campaigns_name UNIQUE (name);
ALTER TABLE ONLY public.chunks
    ADD CONSTRAINT uq_chunks_run_id UNIQUE (run_id, channel, seq);
ALTER TABLE ONLY public.discovery_steps
    ADD CONSTRAINT uq_discovery_steps_discovery_id UNIQUE (discovery_id, seq);
ALTER TABLE ONLY public.machine_models
    ADD CONSTRAINT uq_machine_models_machine UNIQUE (machine, version);
ALTER TABLE ONLY public.machines
    ADD CONSTRAINT uq_machines_name UNIQUE (name, doc_hash);
ALTER TABLE ONLY public.runs
    ADD CONSTRAINT uq_runs_campaign_id UNIQUE (campaign_id, label);
ALTER TABLE ONLY public.slots
    ADD CONSTRAINT uq_slots_schedule UNIQUE (schedule, slot_utc);
CREATE INDEX ix_discoveries_campaign_id ON public.discoveries USING btree (campaign_id);
CREATE INDEX ix_outbox_sent_utc ON public.outbox USING btree (sent_utc);
CREATE INDEX ix_pushes_machine_id ON public.pushes USING btree (machine_id);
CREATE INDEX ix_solutions_campaign_id ON public.solutions USING btree (campaign_id);
CREATE INDEX ix_tables_machine_id ON public.tables USING btree (machine_id);
CREATE INDEX ix_verifications_machine_id ON public.verifications USING btree (machine_id);
ALTER TABLE ONLY public.campaigns
    ADD CONSTRAINT fk_campaigns_machine_id FOREIGN KEY (machine_id) REFERENCES public.machines(id);
ALTER TABLE ONLY public.chunks
    ADD CONSTRAINT fk_chunks_run_id FOREIGN KEY (run_id) REFERENCES public.runs(id);
ALTER TABLE ONLY public.discoveries
    ADD CONSTRAINT fk_discoveries_campaign_id FOREIGN KEY (campaign_id) REFERENCES public.campaigns(id);
ALTER TABLE ONLY public.discovery_steps
    ADD CONSTRAINT fk_discovery_steps_discovery_id FOREIGN KEY (discovery_id) REFERENCES public.discoveries(id);
ALTER TABLE ONLY public.machine_models
    ADD CONSTRAINT fk_machine_models_discovery_id FOREIGN KEY (discovery_id) REFERENCES public.discoveries(id);
ALTER TABLE ONLY public.pushes
    ADD CONSTRAINT fk_pushes_machine_id FOREIGN KEY (machine_id) REFERENCES public.machines(id);
ALTER TABLE ONLY public.pushes
    ADD CONSTRAINT fk_pushes_table_id FOREIGN KEY (table_id) REFERENCES public.tables(id);
ALTER TABLE ONLY public.runs
    ADD CONSTRAINT fk_runs_campaign_id FOREIGN KEY (campaign_id) REFERENCES public.campaigns(id);
ALTER TABLE ONLY public.solutions
    ADD CONSTRAINT fk_solutions_campaign_id FOREIGN KEY (campaign_id) REFERENCES public.campaigns(id);
ALTER TABLE ONLY public.tables
    ADD CONSTRAINT fk_tables_machine_id FOREIGN KEY (machine_id) REFERENCES public.machines(id);
ALTER TABLE ONLY public.tables
    ADD CONSTRAINT fk_tables_solution_id FOREIGN KEY (solution_id) REFERENCES public.solutions(id);
ALTER TABLE ONLY public.verifications
    ADD CONSTRAINT fk_verifications_campaign_id FOREIGN KEY (campaign_id) REFERENCES public.campaigns(id);
ALTER TABLE ONLY public.verifications
    ADD CONSTRAINT fk_verifications_machine_id FOREIGN KEY (machine_id) REFERENCES public.machines(id);
